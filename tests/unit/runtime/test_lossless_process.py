"""A stage in a process that loses nothing: all comes and is given in order, and faults are told."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from companion.config import Config
from companion.errors import DeviceError, InputError, StageError
from companion.messages import Frame
from companion.runtime import stage_start
from companion.runtime.lossless_process import LosslessProcess
from companion.runtime.parcel import Parcel
from companion.runtime.stage_protocol import Finish, Setup
from companion.runtime.stage_start import start_alone
from companion.runtime.stages import QUEUE_BYTES, UNREAD_BYTES
from tests.support.flights.topic_flight import CAMERA
from tests.support.processes.tiny_stages import ERRORS, SOURCE, UNUSABLE, Do, Said

SETUP = Setup(Config(), CAMERA, is_live=False)
NOT_HURRIED = Finish(hurry=False)
SIDE = 800


@pytest.fixture
def remarks() -> list[str]:
    return []


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch, remarks: list[str]) -> Iterator[LosslessProcess]:
    """The stage of which only the newest frame counts in flight."""
    monkeypatch.setattr(stage_start, "CHILD", "tests.support.processes.tiny_stage_child")
    made = LosslessProcess(SOURCE, start_alone, remarks.append)
    yield made
    made.kill()


def given_at_last(tiny: LosslessProcess) -> list[Any]:
    tiny.ask_to_finish(NOT_HURRIED)
    tiny.close()
    return [tiny.given.get().open() for _ in range(tiny.given.qsize())]


def do(tiny: LosslessProcess, what: str, detail: str = "") -> None:
    tiny.put(Parcel.of(Do(1, what, detail)))


def frame(seq: int) -> Parcel:
    grey = np.zeros((SIDE, SIDE), np.uint8)
    return Parcel.of(Frame(seq, seq, grey, np.zeros((SIDE, SIDE, 3), np.uint8)))


def test_all_come_in_order_and_all_is_given(tiny: LosslessProcess, remarks: list[str]) -> None:
    tiny.begin(SETUP)
    do(tiny, "remark", "it is up")
    sent = []
    for n in range(200):
        if n % 3:
            do(tiny, "say", str(n))
        else:
            tiny.put(frame(n))
        sent.append(str(n))
    given = given_at_last(tiny)
    assert [each.text for each in given] == [*sent, "at leisure"]
    assert tiny.fault is None
    assert remarks == ["it is up"]
    assert tiny.progress.n_done == 67 and tiny.progress.n_dropped == 0
    assert tiny.progress.peak_memory_mb > 10.0


def test_it_may_give_more_than_is_taken(tiny: LosslessProcess) -> None:
    """Neither waits for the other for ever."""
    tiny.begin(SETUP)
    for _ in range(50):
        tiny.put(frame(1))
        do(tiny, "say much", "x")
    assert sum(isinstance(each, Said) for each in given_at_last(tiny)) == 50 * 31 + 1


def test_whoever_feeds_waits_for_room(tiny: LosslessProcess) -> None:
    tiny.begin(SETUP)
    stopped = psutil.Process(tiny._process.pid)
    stopped.suspend()
    room = (QUEUE_BYTES + UNREAD_BYTES) // (4 * SIDE * SIDE)
    n_put = 0
    more = threading.Condition()

    def feed() -> None:
        nonlocal n_put
        for seq in range(3 * room):
            tiny.put(frame(seq))
            with more:
                n_put += 1
                more.notify_all()

    feeder = threading.Thread(target=feed)
    feeder.start()
    with more:
        assert more.wait_for(lambda: n_put >= room, 30)
    assert n_put <= room + 4
    stopped.resume()
    feeder.join(30)
    given = given_at_last(tiny)
    assert [each.text for each in given] == [*map(str, range(3 * room)), "at leisure"]


@pytest.mark.parametrize("which", ERRORS)
def test_what_it_raises_is_raised_here_after_what_was_given_before(
    tiny: LosslessProcess, which: str
) -> None:
    tiny.begin(SETUP)
    do(tiny, "say", "before")
    do(tiny, "raise", which)
    do(tiny, "say", "after")
    last = given_at_last(tiny)
    assert [each.text for each in last] == ["before"]
    error, fault = ERRORS[which], tiny.fault
    is_told = which == "not pickled"
    assert type(fault) is (StageError if is_told else type(error))
    assert str(fault) == (f"Local: {error}" if is_told else str(error))
    if isinstance(fault, DeviceError):
        assert fault.detail == "by what its driver says"


def test_one_that_cannot_begin_raises_as_it_begins(tiny: LosslessProcess) -> None:
    tiny.begin(Setup(Config(), CAMERA, Path(UNUSABLE), is_live=False))
    with pytest.raises(InputError, match="cannot be used"):
        tiny.wait_until_up()


def test_a_driver_that_crashes_ends_the_process_alone(tiny: LosslessProcess) -> None:
    tiny.begin(SETUP)
    do(tiny, "crash")
    assert given_at_last(tiny) == []
    assert isinstance(tiny.fault, StageError)
    assert str(tiny.fault) == "the process of source: killed by SIGSEGV"
