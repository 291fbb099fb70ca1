"""Order and dates of flights on a computer that gets the time late."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Iterator
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.app.cli import main
from companion.config import LinkConfig
from companion.daemon.flights.flight_dates import FlightDates
from companion.daemon.flights.flights import Flights
from companion.timing.clock import FlightClock
from drivers.mavlink.autopilot_date import N_ALIKE, AutopilotDate
from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.recording import flight_date
from drivers.recording.flight_date import FlightDate, named_by_date, read_date, write_date
from drivers.recording.flights_folder import (
    COUNTER,
    began_unix_s,
    flights_in,
    in_order,
    may_go,
    next_number,
    number_of,
)
from drivers.recording.growing_file import GrowingFile
from drivers.system.clock_is_set import clock_is_set
from drivers.system.journal import Journal
from tests.support.autopilot.memory_port import MemoryPort
from tests.support.flights.recorded import record

S = 1_000_000_000
PRESENT_S = datetime(2026, 11, 22, 4, 0, tzinfo=timezone.utc).timestamp()
Y2000_S = datetime(2000, 1, 1, tzinfo=timezone.utc).timestamp()


def never(*_: Any) -> Any:
    raise AssertionError


class Run:
    """A run of the daemon, on a computer whose clock says this when it starts."""

    def __init__(self, parent: Path, clock_s: float) -> None:
        self.parent = parent
        self.clock = FlightClock(round(clock_s * S) - time.monotonic_ns())
        self.autopilot_ahead_ns: int | None = None
        self.is_set, self.set_forward_ns = False, 0
        self.clock.behind_ns = lambda: self.set_forward_ns  # type: ignore[method-assign]
        self.dates = FlightDates(self.clock, lambda: self.autopilot_ahead_ns, lambda: self.is_set)
        self.flights = Flights(self.clock, Journal({}), never, never, self.dates, never)

    def begin(self) -> Path:
        """A flight begins, and its stages make its folder."""
        folder = self.flights._named(self.parent)
        record(folder, 3)
        return folder

    def look(self) -> None:
        """A second passes in the daemon."""
        self.dates._looked_ns -= S
        if self.dates.step():
            self.dates.write()

    def close(self) -> None:
        assert self.flights._counter is not None
        self.flights._counter.close(5.0)


@pytest.fixture
def begun(tmp_path: Path) -> Iterator[Any]:
    runs: list[Run] = []

    def begin(clock_s: float) -> Run:
        runs.append(Run(tmp_path, clock_s))
        return runs[-1]

    yield begin
    for run in runs:
        run.close()


def names(parent: Path) -> list[str]:
    return [each.path.name for each in flights_in(parent)]


def listed(parent: Path, capsys: pytest.CaptureFixture[str]) -> list[dict[str, Any]]:
    assert main(["flights", "list", "--flights", str(parent), "--json"]) == 0
    found: list[dict[str, Any]] = json.loads(capsys.readouterr().out)
    return found


def test_a_clock_that_jumps_between_flights_changes_no_order(
    begun: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record(tmp_path / "2026-10-01T00-00-00Z", 3)  # of a version that numbered none
    flown = [begun(clock_s).begin().name for clock_s in (PRESENT_S, 0.0, Y2000_S, PRESENT_S + 60)]
    assert [number_of(name) for name in flown] == [1, 2, 3, 4]
    assert names(tmp_path) == ["2026-10-01T00-00-00Z", *flown]
    assert [row["flight"] for row in listed(tmp_path, capsys)] == names(tmp_path)
    prune = ["flights", "prune", "--flights", str(tmp_path)]
    assert main([*prune, "--keep-newest", "3"]) == 0
    assert names(tmp_path) == flown[1:]
    assert [each.path.name for each in may_go(flights_in(tmp_path))] == flown[1:]  # for the daemon
    days = max(0.0, time.time() - PRESENT_S) / 86400
    assert main([*prune, "--older-than", str(days + 400)]) == 0
    assert names(tmp_path) == flown[1:]  # none of 1970 or 2000 is as old as its name


def test_a_flight_of_unknown_date_is_no_older_than_the_next_that_has_one(tmp_path: Path) -> None:
    days = max(0.0, time.time() - PRESENT_S) / 86400
    flights = [
        "00001-2026-08-01T00-00-00Z", "00002-1970-01-01T00-00-10Z", "00003-2026-11-22T04-00-00Z",
        "00004-1970-01-01T00-00-10Z",
    ]  # fmt: skip
    for name in flights:
        record(tmp_path / name, 3)
    prune = ["flights", "prune", "--flights", str(tmp_path), "--older-than"]
    assert main([*prune, str(days + 50)]) == 0
    assert names(tmp_path) == flights[1:]
    assert main([*prune, str(0.5 * days)]) == 0
    assert names(tmp_path) == flights[3:], "nobody knows when the last was flown"


def test_numbers_outlive_flights_and_the_counters_file(begun: Any, tmp_path: Path) -> None:
    run = begun(PRESENT_S)
    first, second = run.begin(), run.begin()
    assert (number_of(first.name), number_of(second.name)) == (1, 2)
    run.close()
    assert (tmp_path / COUNTER).read_text() == "2\n"
    second.rename(tmp_path.with_name("elsewhere"))
    assert next_number(tmp_path) == 3
    for damaged in (b"", b"\0\0\0\0", b"many", b"-7"):
        (tmp_path / COUNTER).write_bytes(damaged)
        assert next_number(tmp_path) == 2
    (tmp_path / COUNTER).unlink()
    assert next_number(tmp_path) == 2
    assert next_number(tmp_path / "none") == 1


def test_two_flights_at_once_have_two_folders(begun: Any, tmp_path: Path) -> None:
    run = begun(PRESENT_S)
    assert len({run.flights._named(tmp_path) for _ in range(5)}) == 5


def test_names_of_all_versions_are_in_order() -> None:
    names = [
        "00010-2000-01-01T00-00-00Z", "00009-2026-11-01T00-00-00Z", "123456-1970-01-01T00-00-00Z",
        "2026-01-01T00-00-00Z-2", "2026-01-01T00-00-00Z", "2025-01-01T00-00-00Z", "holiday",
    ]  # fmt: skip
    assert in_order(names) == [names[n] for n in (5, 4, 3, 1, 0, 2)]
    assert began_unix_s("00009-2026-11-01T00-00-00Z") == 1793491200.0
    assert began_unix_s("00010-2000-01-01T00-00-00Z") is None
    assert began_unix_s("00010-2026-13-01T00-00-00Z") is None


def test_the_autopilots_date_corrects_the_flight_at_its_end(
    begun: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = begun(Y2000_S)
    folder = run.begin()
    assert "2000-01-01" in folder.name
    run.look()
    assert read_date(folder) is None
    run.autopilot_ahead_ns = round((PRESENT_S - Y2000_S) * S)
    run.look()
    date = read_date(folder)
    assert date is not None and date.by == "the autopilot" and folder.exists()
    assert abs(date.began_unix_s - PRESENT_S) < 60
    before = (folder / "flight.mcap").read_bytes()
    (row,) = listed(tmp_path, capsys)
    now_at = run.dates.ended(folder)
    assert now_at.name.startswith("00001-2026-11-22T04-0") and not folder.exists()
    assert (now_at / "flight.mcap").read_bytes() == before
    assert listed(tmp_path, capsys)[0]["start"] == row["start"]
    assert main(["flights", "show", now_at.name, "--flights", str(tmp_path), "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["clock_correction_s"] == pytest.approx(PRESENT_S - Y2000_S)
    later = run.begin()  # named right at once, and its recording's times are as wrong
    assert later.name.startswith("00002-2026-11-22T04-0")
    run.look()
    assert read_date(later) is not None
    assert run.dates.ended(later) == later


def test_the_networks_time_corrects_flights_that_are_over(begun: Any, tmp_path: Path) -> None:
    run = begun(0.0)
    folders = [run.begin() for _ in range(2)]
    assert [run.dates.ended(folder) for folder in folders] == folders
    gone = run.begin()
    run.dates.ended(gone)
    for path in gone.iterdir():
        path.unlink()
    gone.rmdir()
    run.set_forward_ns, run.is_set = round(PRESENT_S * S), True
    run.look()
    assert [name[:17] for name in names(tmp_path)] == ["00001-2026-11-22T", "00002-2026-11-22T"]
    assert not gone.exists()


def test_a_clock_that_somebody_sets_is_believed_and_one_that_is_wrong_anyway_is_not(
    begun: Any,
) -> None:
    run = begun(Y2000_S)
    folder = run.begin()
    run.set_forward_ns = 3600 * S  # still in 2000
    run.look()
    assert read_date(folder) is None
    run.autopilot_ahead_ns = -5000 * S  # a receiver's own idea of the year
    run.look()
    assert read_date(folder) is None
    run.autopilot_ahead_ns, run.set_forward_ns = None, round((PRESENT_S - Y2000_S) * S)
    run.look()
    date = read_date(folder)
    assert date is not None and "was set" in date.by


def test_a_right_clock_changes_nothing(begun: Any) -> None:
    run = begun(PRESENT_S)
    run.is_set, run.set_forward_ns, run.autopilot_ahead_ns = True, S // 2, -S // 2
    folder = run.begin()
    run.look()
    assert run.dates.ended(folder) == folder
    assert read_date(folder) is None


def test_what_a_crash_has_left_is_named_by_repair(tmp_path: Path) -> None:
    folder = tmp_path / "00007-1970-01-01T00-01-00Z"
    record(folder, 3)
    write_date(folder, FlightDate(PRESENT_S, PRESENT_S - 60, "the autopilot"))
    assert main(["flights", "repair", "--gently", "--flights", str(tmp_path)]) == 0
    assert names(tmp_path) == ["00007-2026-11-22T04-00-00Z"]
    assert main(["flights", "repair", "--flights", str(tmp_path)]) == 0
    assert names(tmp_path) == ["00007-2026-11-22T04-00-00Z"]


def test_what_is_recorded_now_keeps_its_name(tmp_path: Path) -> None:
    folder = tmp_path / "00007-1970-01-01T00-01-00Z"
    folder.mkdir()
    growing = GrowingFile(folder / "flight.mcap")
    write_date(folder, FlightDate(PRESENT_S, PRESENT_S - 60, "the autopilot"))
    assert named_by_date(folder) == folder
    growing.close()
    assert named_by_date(folder).name == "00007-2026-11-22T04-00-00Z"


@pytest.mark.parametrize("data", [b"", b"{", b"[]", b'{"began_unix_s": "x"}'])
def test_a_damaged_date_is_none(tmp_path: Path, data: bytes) -> None:
    (tmp_path / flight_date.FILE).write_bytes(data)
    assert read_date(tmp_path) is None


async def test_the_autopilot_is_believed_when_it_says_so_again_and_again() -> None:
    port, clock = MemoryPort(), FlightClock(0)
    link = AutopilotLink(LinkConfig(), port, clock, lambda _: None, lambda _: None)
    date = AutopilotDate(link)
    running = asyncio.ensure_future(link.run())
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    port.hear(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3), 0)

    def hear(unix_s: float, t_s: float) -> None:
        boot_ms = round(t_s * 1e3) + 5000
        port.hear(mavlink.MAVLink_system_time_message(round(unix_s * 1e6), boot_ms), round(t_s * S))

    for n in range(N_ALIKE):
        hear(0.0, float(n))
    assert date.ahead_ns is None
    for n in range(N_ALIKE):  # each of another year
        hear(PRESENT_S + 1e7 * n, 10.0 + n)
    assert date.ahead_ns is None
    for n in range(N_ALIKE):
        hear(PRESENT_S + n, 20.0 + n)
    assert date.ahead_ns == pytest.approx((PRESENT_S - 20.0) * S, abs=S)
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)


def test_the_kernel_says_whether_its_clock_is_kept_in_step() -> None:
    assert clock_is_set() in (True, False)
