"""Flights know of the motors what the autopilot said before they began."""

from __future__ import annotations

import asyncio
import threading
from pathlib import Path
from typing import Any

import pytest

from companion.config import Config, DaemonConfig
from companion.daemon.flights import flights as module
from companion.daemon.flights.flight_dates import FlightDates
from companion.daemon.flights.flights import Flights
from companion.geometry.camera import Camera
from companion.telemetry import ArmedSample
from companion.timing.clock import FlightClock
from drivers.recording.flights_folder import flights_in, flown_in
from drivers.system.journal import Journal

CAMERA = Camera(64, 48, 50.0, 50.0, 32.0, 24.0)


class Begun:
    """A flight without processes."""

    def __init__(self, *_: Any) -> None:
        self.taken: list[Any] = []
        self.folder: Path | None = None
        self.kept, self.n_frames = False, 0

    def begin(self, folder: Path, keep: Any) -> None:
        self.folder = folder
        folder.mkdir()
        (folder / "flight.mcap").write_bytes(b"all of it")

    def hurry(self) -> None:
        assert not self.kept

    def finish(self, facts: Any) -> None:
        pass

    def take(self, message: Any) -> None:
        self.taken.append(message)


def without_processes(monkeypatch: pytest.MonkeyPatch) -> tuple[Flights, FlightClock]:
    monkeypatch.setattr(module, "LiveFlight", Begun)
    clock = FlightClock()
    nothing: Any = None
    dates = FlightDates(clock, lambda: None, lambda: True)
    return Flights(clock, Journal(), nothing, nothing, dates, nothing), clock


@pytest.mark.parametrize("armed", [True, False, None])
def test_a_flight_is_told_whether_the_motors_are_armed(
    armed: bool | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is heard on change only, and that may have been before the camera was there."""
    flights, clock = without_processes(monkeypatch)
    if armed is not None:
        flights.take(ArmedSample(clock.now_ns(), armed))
    began_ns = clock.now_ns()
    config = Config(daemon=DaemonConfig(flights=str(tmp_path)))
    flight: Any = flights.begin(config, CAMERA)
    assert flights._counter is not None
    flights._counter.close(10.0)
    told = [each.armed for each in flight.taken if isinstance(each, ArmedSample)]
    assert told == ([] if armed is None else [armed])
    assert all(each.t_ns >= began_ns for each in flight.taken)


@pytest.mark.parametrize("armed", [False, True])
def test_a_flight_that_was_never_armed_leaves_nothing(
    armed: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flights, _ = without_processes(monkeypatch)
    config = Config(daemon=DaemonConfig(flights=str(tmp_path)))
    flight: Any = flights.begin(config, CAMERA, keep=False)
    mark = flights._mark
    assert mark is not None and mark.wait(60)
    assert [each.unarmed for each in flights_in(tmp_path)] == [True] and not flown_in(tmp_path)
    if armed:
        flights.keep()
        assert mark.wait(60)
        assert [each.path for each in flown_in(tmp_path)] == [flight.folder]
    flights.end()
    for thread in list(flights._ending.values()):
        thread.join(60)
    assert flight.folder.exists() == armed
    assert flights._counter is not None
    flights._counter.close(10.0)


@pytest.mark.parametrize("in_a_hurry", [False, True])
def test_results_are_waited_for_unless_in_a_hurry(
    in_a_hurry: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A person who presses Ctrl-C once waits, whom the service manager's signal does not."""
    flights, _ = without_processes(monkeypatch)
    config = Config(daemon=DaemonConfig(flights=str(tmp_path)))
    flight: Any = flights.begin(config, CAMERA)
    written = threading.Event()
    said: list[str] = []
    asked = 0

    def hurry() -> None:
        said.append("hurry")
        written.set()

    def finish(_: Any) -> None:
        said.append("results" if written.wait(60) else "none")

    flight.hurry, flight.finish = hurry, finish

    def hurried() -> bool:
        nonlocal asked
        asked += 1
        if asked == 5 and not in_a_hurry:
            written.set()
        return in_a_hurry

    asyncio.run(flights.close(5.0, hurried, keep_map=False))
    assert said[:2] == (["hurry", "results"] if in_a_hurry else ["results"])
    assert flights._counter is not None
    flights._counter.close(10.0)
