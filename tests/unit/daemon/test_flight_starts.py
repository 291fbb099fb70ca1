"""Begin of flights: what follows where one cannot begin, or its localisation dies."""

from __future__ import annotations

import asyncio
import errno
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from companion.config import Config
from companion.daemon.flight_starts import (
    CHANGED_S,
    LONGEST_PAUSE_S,
    PREPARE_S,
    REST_S,
    SHORT_S,
    STANDBY_RETRY_S,
    FlightStarts,
)
from companion.daemon.flights import flights as flights_module
from companion.daemon.flights.flight_dates import FlightDates
from companion.daemon.flights.flights import Flights
from companion.timing.clock import FlightClock
from drivers.system.journal import Journal
from tests.support.flights.topic_flight import CAMERA

NO_PROCESS = OSError(errno.EAGAIN, "Resource temporarily unavailable")
NO_THREAD = RuntimeError("can't start new thread")


class Later:
    """An event loop in which time passes by hand."""

    def __init__(self) -> None:
        self.due: list[tuple[float, Callable[..., None], tuple[Any, ...]]] = []

    def call_later(self, pause_s: float, call: Callable[..., None], *arguments: Any) -> Any:
        entry = pause_s, call, arguments
        self.due.append(entry)

        def cancel() -> None:
            if entry in self.due:
                self.due.remove(entry)

        return SimpleNamespace(cancel=cancel)

    def pass_on(self) -> float:
        """Call what is due next; the pause before it."""
        pause_s, call, arguments = self.due.pop(0)
        call(*arguments)
        return pause_s


class Begun:
    """Flights that can begin as long as nothing is refused."""

    def __init__(self) -> None:
        self.current: Any = None
        self.standby: Any = None
        self.refused: dict[str, list[Exception]] = {"prepare": [], "begin": []}
        self.taken_up: list[bool] = []
        self.n_written = 0

    def prepare(self, *_: Any) -> None:
        self._refuse("prepare")
        self.standby = self.standby or SimpleNamespace(believed=(), duration_s=0.0)

    def begin(self, _config: Config, _camera: Any, take_up: bool, keep: bool) -> Any:
        self.taken_up.append(take_up)
        self._refuse("begin")
        self.current, self.standby = self.standby, None
        self.current.kept = keep
        return self.current

    def keep(self) -> None:
        if self.current is not None:
            self.current.kept = True

    def write_results(self) -> None:
        self.n_written += 1

    def end(self) -> None:
        self.current = None

    def discard_standby(self) -> None:
        self.standby = None

    def _refuse(self, what: str) -> None:
        if self.refused[what]:
            raise self.refused[what].pop(0)


class Scene:
    """The starts of flights, at once unless `by_arming`."""

    def __init__(self, by_arming: bool = False) -> None:
        self.flights, self.later, self.said = Begun(), Later(), list[str]()
        self.watch = SimpleNamespace(restart=lambda: None, flight_due=False)
        settings = SimpleNamespace(config=Config(), armed=False, set_armed=lambda armed: None)
        sender = SimpleNamespace(restart=lambda: None, begin_flight=lambda use: None)
        parts: tuple[Any, ...] = (
            settings, None, self.flights, sender if by_arming else None, None,
            self.watch, Journal({}), SimpleNamespace(made=False),
            self.said.append,
        )  # fmt: skip
        self.starts = FlightStarts(*parts)
        loop: Any = self.later
        self.starts._loop, self.starts.camera = loop, CAMERA


@pytest.fixture
def scene() -> Iterator[Callable[..., Scene]]:
    async def made(by_arming: bool) -> Scene:
        return Scene(by_arming)

    yield lambda by_arming=False: asyncio.run(made(by_arming))


@pytest.mark.parametrize("what", ["prepare", "begin"])
def test_a_flight_that_cannot_begin_is_tried_again(scene: Callable[..., Scene], what: str) -> None:
    made = scene()
    made.flights.refused[what] = [NO_PROCESS, NO_THREAD]
    made.starts.begin_flight()
    assert made.flights.current is None
    assert made.later.pass_on() == STANDBY_RETRY_S
    assert made.flights.current is None and made.watch.flight_due
    made.later.pass_on()
    assert not made.watch.flight_due
    assert made.flights.current is not None and not made.later.due
    assert made.said == ["Resource temporarily unavailable", "can't start new thread"]
    assert not any(made.flights.taken_up), "it has a map of its own"


def test_a_standby_flight_that_cannot_be_prepared_is_tried_again(
    scene: Callable[..., Scene],
) -> None:
    made = scene(by_arming=True)
    made.flights.refused["prepare"] = [NO_PROCESS]
    made.starts.prepare()
    assert made.flights.standby is None and not made.watch.flight_due
    made.later.pass_on()
    assert made.flights.standby is not None and made.flights.current is None
    made.starts.set_armed(True)
    assert made.flights.current is not None


def test_flights_that_die_soon_one_after_the_other_have_pauses(
    scene: Callable[..., Scene],
) -> None:
    made = scene()
    made.starts.begin_flight()
    pauses = []
    for _ in range(1200):
        made.starts.localisation_died(made.flights.current)
        pauses.append(0.0 if made.flights.current is not None else made.later.pass_on())
        assert made.flights.current is not None and not made.later.due
    assert pauses[:6] == [0.0, 2.0, 4.0, 8.0, 10.0, 10.0]
    assert max(pauses) == LONGEST_PAUSE_S
    made.flights.current.duration_s = SHORT_S
    for _ in range(2):  # after a longer one all is as at first
        made.starts.localisation_died(made.flights.current)
        assert made.flights.current is not None and not made.later.due


def test_arming_does_not_wait_for_a_pause(scene: Callable[..., Scene]) -> None:
    made = scene(by_arming=True)
    made.starts.set_armed(True)
    made.starts.localisation_died(made.flights.current)
    made.starts.localisation_died(made.flights.current)
    assert made.flights.current is None and made.watch.flight_due
    made.starts.set_armed(False)
    made.starts.set_armed(True)
    again = made.flights.current
    assert again is not None
    made.later.pass_on()
    assert made.flights.current is again


def test_localisation_runs_from_the_autopilots_first_word_and_arming_keeps_the_flight(
    scene: Callable[..., Scene],
) -> None:
    made = scene(by_arming=True)
    made.starts.prepare()
    assert made.flights.current is None
    made.starts.set_armed(False)
    flight = made.flights.current
    assert flight is not None and not flight.kept
    made.starts.set_armed(True)
    assert made.flights.current is flight and flight.kept
    assert not made.later.due, "a flight in the air gives way to nothing"
    made.starts.set_armed(False)
    assert made.flights.current is flight and made.flights.n_written == 1
    made.starts.set_armed(True)
    made.starts.set_armed(False)
    assert made.flights.current is flight and made.flights.n_written == 2


def test_a_flight_on_the_ground_gives_way_to_another(scene: Callable[..., Scene]) -> None:
    made = scene(by_arming=True)
    made.starts.set_armed(False)
    first = made.flights.current
    assert made.later.pass_on() == REST_S - PREPARE_S
    assert made.flights.standby is not None and made.flights.current is first
    assert made.later.pass_on() == PREPARE_S
    second = made.flights.current
    assert second is not first and not second.kept and made.flights.taken_up == [True, False]
    assert made.later.pass_on() == REST_S - PREPARE_S
    made.starts.set_armed(True)
    assert made.flights.current is second and second.kept
    assert made.flights.standby is None and not made.later.due


def test_a_flight_is_ended_on_request_on_the_ground_only(scene: Callable[..., Scene]) -> None:
    made = scene(by_arming=True)
    made.starts.set_armed(True)
    flight = made.flights.current
    assert not made.starts.end_flight() and made.flights.current is flight
    made.starts.set_armed(False)
    assert made.starts.end_flight()
    assert made.flights.current is not flight and not made.flights.current.kept
    assert not scene().starts.end_flight(), "each flight lasts as long as the daemon"


def test_a_process_restarted_in_the_air_keeps_its_flight(scene: Callable[..., Scene]) -> None:
    made = scene(by_arming=True)
    made.starts.set_armed(True)
    assert made.flights.current.kept and made.flights.taken_up == [True] and not made.later.due


def test_changed_settings_of_stages_begin_another_map_on_the_ground_only(
    scene: Callable[..., Scene],
) -> None:
    made = scene(by_arming=True)
    old = Config()
    other = replace(old, features=replace(old.features, n_features=old.features.n_features + 100))
    limits = replace(old, feedback=replace(old.feedback, max_sigma_m=0.5))
    made.starts.set_armed(False)
    flight = made.flights.current
    flight.set_dense = flight.set_budget = lambda _: None
    made.starts.reconfigure(old, limits)
    assert made.flights.current is flight
    for _ in range(3):
        made.starts.reconfigure(old, other)
    assert made.flights.current is flight
    assert made.later.pass_on() == CHANGED_S
    second = made.flights.current
    assert second is not None and second is not flight
    second.set_dense = second.set_budget = lambda _: None
    made.starts.set_armed(True)
    made.starts.reconfigure(old, other)
    assert made.flights.current is second and not made.later.due


def test_a_flight_that_fails_as_it_begins_is_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ended: list[Any] = []

    class Failing:
        """A flight whose last thread is refused."""

        def __init__(self, *_: Any) -> None:
            self.folder, self.n_frames, self.kept = None, 0, False

        def begin(self, *_: Any) -> None:
            raise NO_THREAD

        def hurry(self) -> None:
            pass

        def finish(self, _facts: Any) -> None:
            ended.append(self)

    def never(*_: Any) -> Any:
        raise AssertionError

    monkeypatch.setattr(flights_module, "LiveFlight", Failing)
    clock, config = FlightClock(), Config()
    config = replace(config, daemon=replace(config.daemon, flights=str(tmp_path)))
    dates = FlightDates(clock, lambda: None, lambda: True)
    flights = Flights(clock, Journal({}), never, never, dates, never)
    with pytest.raises(RuntimeError):
        flights.begin(config, CAMERA)
    for thread in list(flights._ending.values()):
        thread.join()
    assert len(ended) == 1 and flights.current is None and flights.standby is None
    assert flights._counter is not None
    flights._counter.close(5.0)
