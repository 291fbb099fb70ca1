"""A stage in a forked process: it gives what it would give here, and how its faults are told."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
import pytest

from companion.config import Config
from companion.errors import DeviceError, StageError
from companion.messages import Frame, Warned
from companion.runtime import forked_work
from companion.runtime.forked_work import ForkedWork
from companion.runtime.in_order import InOrder
from companion.runtime.stage_protocol import Finish, Remark, Setup
from companion.runtime.stage_work import Work
from companion.runtime.stages import stage_named
from companion.telemetry import RangeSample
from tests.support.flights.topic_flight import CAMERA

# of a test's process that has threads of other tests; a replay forks only where it has none
pytestmark = pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
NOT_HURRIED = Finish(hurry=False)


class Echo(Work):
    """Gives what it is told to for each message."""

    def __init__(self, gives: Callable[[Any], Iterable[Any]]) -> None:
        super().__init__()
        self._gives = gives

    def begin(self, tell: Callable[[Any], None]) -> None:
        self.device = "a device"
        tell(Remark("it begins"))

    def details(self) -> Mapping[str, Any]:
        return {"failures": [1]}

    def step(self, message: Any) -> Iterable[Any]:
        with self.times("step"):
            return self._gives(message)

    def finish(self, finish: Finish) -> Iterable[Any]:
        return self._gives(finish)


def forked(
    monkeypatch: pytest.MonkeyPatch, gives: Callable[[Any], Iterable[Any]], told: list[Any]
) -> ForkedWork:
    class Module:
        def __init__(self, name: str) -> None:
            pass

        def work(self, setup: Setup) -> Work:
            return Echo(gives)

    monkeypatch.setattr(forked_work, "module_of", Module)
    made = ForkedWork("depth", Setup(Config(), CAMERA), nice=0)
    made.begin(told.append)
    return made


def frame(seq: int, side: int = 2) -> Frame:
    return Frame(seq, seq, np.full((side, side), seq, np.uint8), np.zeros((0, 0, 3), np.uint8))


def test_all_come_in_order_and_all_is_given(monkeypatch: pytest.MonkeyPatch) -> None:
    def gives(message: Any) -> list[Any]:
        if isinstance(message, Finish):
            return [Warned(9, "the end")]
        return [message] if isinstance(message, Frame) else [Warned(message.t_ns, "a sample")]

    told: list[Any] = []
    work = forked(monkeypatch, gives, told)
    sent = [RangeSample(t, 1.0) if t % 3 else frame(t, side=800) for t in range(200)]
    given = [out for message in sent for out in work.step(message)] + [*work.finish(NOT_HURRIED)]
    assert [each.t_ns for each in given] == [*range(200), 9]
    assert all((each.grey == each.seq).all() for each in given if isinstance(each, Frame))
    assert told == [Remark("it begins")]
    assert work.device == "a device" and work.details() == {"failures": [1]}
    assert work.times.summary()["step"]["n"] == 200


def test_it_may_give_more_than_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither waits for the other for ever."""
    work = forked(monkeypatch, lambda message: [Warned(1, "x" * 20000)] * 30, [])
    n = sum(len(list(work.step(frame(seq)))) for seq in range(100))
    assert n + len(list(work.finish(NOT_HURRIED))) == 3030


@pytest.mark.parametrize("error", [DeviceError("it is gone"), OSError(28, "no room"), KeyError(3)])
def test_what_it_raises_is_raised_here(
    monkeypatch: pytest.MonkeyPatch, error: Exception, capfd: pytest.CaptureFixture[str]
) -> None:
    def fails(message: Any) -> list[Any]:
        raise error

    work = forked(monkeypatch, fails, [])
    with pytest.raises(type(error), match=str(error.args[-1])):
        for seq in range(1000):
            list(work.step(frame(seq)))
    assert ("Traceback" in capfd.readouterr().err) == isinstance(error, KeyError)


def test_what_was_given_before_is_not_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    def gives(message: Any) -> list[Any]:
        if message.seq == 20:
            raise MemoryError("no room")
        return [message]

    work = forked(monkeypatch, gives, [])
    given: list[Any] = []
    with pytest.raises(MemoryError, match="no room"):
        for seq in range(1000):
            for out in work.step(frame(seq)):
                given.append(out.seq)
    assert given == list(range(20))


def test_a_driver_that_crashes_ends_the_process_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    def crashes(message: Any) -> list[Any]:
        os.kill(os.getpid(), signal.SIGKILL)
        return []

    work = forked(monkeypatch, crashes, [])
    with pytest.raises(StageError, match="the process of depth was ended by SIGKILL"):
        list(work.finish(NOT_HURRIED))


def test_results_of_a_process_that_fails_are_told(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def fails(message: Any) -> list[Any]:
        raise OSError(28, "no room")

    list(forked(monkeypatch, lambda message: [], []).finish(NOT_HURRIED))
    monkeypatch.setattr(Echo, "finish", lambda self, finish: fails(finish))
    monkeypatch.setattr("os.listdir", lambda path: ["one thread"])
    stages = InOrder(
        [stage_named("results")], Setup(Config(), CAMERA), lambda _: None, print, ("results",)
    )
    stages.feed(frame(1))
    with pytest.raises(OSError, match="no room"):
        stages.finish(lambda stage: NOT_HURRIED)
