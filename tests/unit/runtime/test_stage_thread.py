from __future__ import annotations

import threading
import tracemalloc

import numpy as np
import pytest

from companion.messages import Frame, HeightSample, Message
from companion.runtime.pipeline import DEPTH_QUEUE_BYTES, StageThread

SIDE = 2000
LARGE_BYTES = 4 * SIDE * SIDE


class Slow:
    """Waits with its first message until it may go on; raises in a step or at the end if asked."""

    def __init__(self, fails_in: str = "") -> None:
        self.may_go_on, self.seen = threading.Event(), 0
        self._fails_in = fails_in

    def step(self, message: Message) -> list[Message]:
        self.may_go_on.wait(30)
        self.seen += 1
        if self._fails_in == "step":
            raise ValueError("in a step")
        return [message]

    def flush(self) -> list[Message]:
        if self._fails_in == "flush":
            raise ValueError("at the end")
        return []


def large(seq: int) -> Frame:
    shape = SIDE, SIDE
    return Frame(seq, seq, np.zeros(shape, np.uint8), np.zeros((*shape, 3), np.uint8))


@pytest.mark.parametrize("where", ["step", "flush"])
@pytest.mark.parametrize("lossless", [True, False])
def test_a_stage_that_fails_is_reported_and_nobody_waits(where: str, lossless: bool) -> None:
    stage = Slow(where)
    stage.may_go_on.set()
    thread = StageThread(stage, lossless)
    for t_ns in range(500):
        thread.put(HeightSample(t_ns, 1.0))
    got = list(thread.close())
    assert isinstance(thread.fault, ValueError)
    assert len(got) == (500 if where == "flush" else 0)


def test_large_pictures_that_wait_are_dropped_where_time_does_not_wait() -> None:
    stage = Slow()
    thread = StageThread(stage, lossless=False)
    tracemalloc.start()
    try:
        for seq in range(30):
            thread.put(large(seq))
        held, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert held < DEPTH_QUEUE_BYTES + 2 * LARGE_BYTES
    stage.may_go_on.set()
    n_kept = len(list(thread.close()))
    assert 0 < n_kept < 12
    assert thread.n_dropped == 30 - n_kept


def test_in_lockstep_whoever_gives_waits_and_nothing_is_lost() -> None:
    stage = Slow()
    thread = StageThread(stage, lossless=True)
    given = threading.Event()

    def give() -> None:
        for seq in range(20):
            thread.put(large(seq))
        given.set()

    giver = threading.Thread(target=give)
    giver.start()
    assert not given.wait(0.5)
    stage.may_go_on.set()
    giver.join(60)
    list(thread.close())
    assert (stage.seen, thread.n_dropped, thread.fault) == (20, 0, None)
