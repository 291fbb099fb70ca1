"""Repair of recordings that were cut short: by command, and by the daemon in the background."""

from __future__ import annotations

import asyncio
import errno
import fcntl
import os
from pathlib import Path
from typing import Any

import psutil
import pytest

from companion.app.cli import main
from companion.daemon.flights import recording_recovery
from companion.daemon.flights.recording_recovery import (
    CUT_SHORT,
    NOT_REPAIRED,
    RecordingRecovery,
)
from companion.messages import Warned
from companion.pilot_messages import of_warning
from companion.timing.clock import FlightClock
from drivers.recording.flight_summary import summarise
from drivers.recording.repair import in_place, unfinished
from drivers.system.low_priority import give_way
from tests.support.flights.recorded import record

PATIENCE_S = 300.0
"""What gives way to all others may wait long, beside other tests."""

WHOLE, CUT = "2026-01-01T00-00-00Z", "2026-01-02T00-00-00Z"


@pytest.fixture
def cut(tmp_path: Path) -> Path:
    """One of two, which lacks its end."""
    for name in (WHOLE, CUT):
        record(tmp_path / name, 10)
    path = tmp_path / CUT / "flight.mcap"
    os.truncate(path, path.stat().st_size - 500)
    return path


def test_by_command_once(cut: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = cut.parents[1]
    (folder / "2026-01-03T00-00-00Z").mkdir()
    (folder / "2026-01-03T00-00-00Z/flight.mcap").touch()  # nothing was ever written to it
    words = ["flights", "repair", "--flights", str(folder)]
    assert main(words) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[0].startswith(f"{cut}: repaired, ")
    assert out[1] == "1 of 3 recordings cut short, 1 repaired"
    assert summarise(cut).state == "repaired" and summarise(cut, lambda n: None).n_lost_bytes == 0
    content = cut.read_bytes()
    assert main(words) == 0
    assert capsys.readouterr().out == "0 of 3 recordings cut short, 0 repaired\n"
    assert cut.read_bytes() == content


def test_what_another_writes_to_is_left_alone(
    cut: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = cut.read_bytes()
    with cut.open("rb") as writing:
        fcntl.flock(writing, fcntl.LOCK_EX)
        assert not unfinished(cut)
        assert in_place(cut) is None
        assert main(["flights", "repair", "--flights", str(cut.parents[1])]) == 0
    assert capsys.readouterr().out == "0 of 2 recordings cut short, 0 repaired\n"
    assert cut.read_bytes() == content


async def until_warned(cut: Path, warned: list[Warned], armed: list[bool]) -> None:
    over = RecordingRecovery(cut.parents[1], FlightClock(), warned.append, lambda: armed[0])
    running = asyncio.ensure_future(over.run())
    await asyncio.sleep(0.2)
    assert not psutil.Process().children()  # as long as it is armed
    armed[0] = False
    while not warned:
        await asyncio.sleep(0.01)
    running.cancel()
    await asyncio.wait([running])


def test_the_daemon_does_it_when_disarmed(cut: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording_recovery, "AFTER_S", 0.01)
    warned: list[Warned] = []
    asyncio.run(asyncio.wait_for(until_warned(cut, warned, [True]), PATIENCE_S))
    (warning,) = warned
    assert warning.what == CUT_SHORT and warning.detail.startswith(f"{cut}: repaired, ")
    assert summarise(cut).state == "repaired"


def test_arming_breaks_it_off(cut: Path) -> None:
    warned: list[Warned] = []
    over = RecordingRecovery(cut.parents[1], FlightClock(), warned.append, lambda: True)
    assert asyncio.run(over._repaired()) is False
    assert not warned and not psutil.Process().children()
    assert unfinished(cut)


def test_where_no_process_can_be_started_another_try_follows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    warned: list[Warned] = []

    async def refuse(*_: Any, **__: Any) -> Any:
        raise OSError(errno.ENOMEM, "Cannot allocate memory")

    async def scene() -> None:
        over = RecordingRecovery(tmp_path, FlightClock(), warned.append, lambda: False)
        running = asyncio.ensure_future(over.run())
        while len(warned) < 2:
            await asyncio.sleep(0)
            assert not running.done()
        running.cancel()
        await asyncio.wait([running])

    monkeypatch.setattr(recording_recovery, "AFTER_S", 0.0)
    monkeypatch.setattr(asyncio, "create_subprocess_exec", refuse)
    asyncio.run(scene())
    assert (warned[0].what, warned[0].detail) == (NOT_REPAIRED, "Cannot allocate memory")


def test_a_folder_that_cannot_be_written_is_told_at_once(tmp_path: Path) -> None:
    warned: list[Warned] = []
    (tmp_path / "file").touch()
    flights = tmp_path / "file" / "flights"

    async def scene() -> None:
        over = RecordingRecovery(flights, FlightClock(), warned.append, lambda: True)
        running = asyncio.ensure_future(over.run())
        while not warned:
            await asyncio.sleep(0)
        running.cancel()
        await asyncio.wait([running])

    asyncio.run(asyncio.wait_for(scene(), PATIENCE_S))
    (warning,) = warned
    assert of_warning(warning.what, warning.detail, warning.good) is not None
    assert warning.detail == f"{flights}: Not a directory; daemon.flights names the folder"


def test_a_process_gives_way_to_all_others() -> None:
    with psutil.Popen(["sleep", "60"]) as process:
        give_way(process.pid)
        assert os.sched_getscheduler(process.pid) == os.SCHED_IDLE
        assert process.ionice().ioclass == psutil.IOPRIO_CLASS_IDLE
        process.kill()
