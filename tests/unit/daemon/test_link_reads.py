"""Bytes of the link on their way to the recorder: gathered, in order, and none left behind."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from companion.config import Config
from companion.daemon.flights import live_flight as module
from companion.daemon.flights.live_flight import GATHER_NS, LiveFlight
from companion.flight_notes import GateStep, LinkBytes, LinkReads
from companion.messages import Warned
from companion.stages import recorder_work
from companion.telemetry import ArmedSample
from companion.timing.clock import FlightClock
from tests.support.flights.topic_flight import CAMERA


class Published:
    """Processes of a flight that keep what they are to pass on."""

    def __init__(self, *_: Any) -> None:
        self.all: list[Any] = []
        self.over = self.hurried = False

    def start(self) -> None: ...

    def fly(self) -> None: ...

    def take(self, message: Any) -> None:
        self.all.append(message)

    def finish(self, _: Callable[..., Any]) -> dict[str, str]:
        self.all.append("finished")
        return {}


@pytest.fixture
def flight(monkeypatch: pytest.MonkeyPatch) -> LiveFlight:
    monkeypatch.setattr(module, "InProcesses", Published)
    nothing: Any = SimpleNamespace(unusable=None)
    flying = LiveFlight(Config(), CAMERA, FlightClock(), lambda _: nothing, nothing)
    flying._processes.by_name = {}
    flying._processes.fly()
    flying._flies = True
    return flying


def read(t_ns: int) -> LinkBytes:
    return LinkBytes(t_ns, t_ns, False, b"%d" % t_ns)


def published(flight: LiveFlight) -> list[Any]:
    processes: Any = flight._processes
    return list(processes.all)


def test_bytes_of_the_link_gather_for_a_while(flight: LiveFlight) -> None:
    times_ns = [0, GATHER_NS // 2, GATHER_NS, GATHER_NS + 1]
    for t_ns in times_ns:
        flight.take(read(t_ns))
    assert published(flight) == [LinkReads(0, tuple(map(read, times_ns[:3])))]


def test_other_messages_wait_for_none(flight: LiveFlight) -> None:
    flight.take(read(0))
    flight.take(ArmedSample(1, True))
    assert [type(each) for each in published(flight)] == [ArmedSample]


def test_the_last_bytes_are_sent_where_the_link_falls_silent(flight: LiveFlight) -> None:
    flight.take(read(1))
    health: Any = SimpleNamespace(t_ns=0)
    flight.publish_health(health, None)
    assert published(flight) == [LinkReads(1, (read(1),))]


def test_a_flight_ends_with_all_bytes_of_its_link(flight: LiveFlight) -> None:
    flight.take(read(1))
    flight.finish(lambda _: None)  # type: ignore[arg-type,return-value]
    assert published(flight) == [LinkReads(1, (read(1),)), "finished"]


def test_a_localisation_that_dies_parts_no_decision_from_its_bytes(flight: LiveFlight) -> None:
    step = GateStep(1, "pose", "frame", 0, True, {})
    flight.take(step)
    flight._processes.over = True  # type: ignore[misc]
    flight.take(read(2))
    flight.take(ArmedSample(3, True))
    flight.take(Warned(4, "published by the stage that gave it"))
    flight.finish(lambda _: None)  # type: ignore[arg-type,return-value]
    kinds = [type(each) for each in published(flight)]
    assert kinds == [GateStep, ArmedSample, LinkReads, str]


def test_they_are_recorded_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[Any] = []
    work = object.__new__(recorder_work._Recorder)
    recorder = SimpleNamespace(take=taken.append, warnings=list)
    monkeypatch.setattr(work, "_recorder", recorder, raising=False)
    sample = ArmedSample(3, True)
    for message in (LinkReads(1, (read(1), read(2))), sample):
        work.step(message)
    assert taken == [read(1), read(2), sample]
