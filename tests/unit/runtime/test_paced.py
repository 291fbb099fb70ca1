"""Message order: by time in lockstep, the newest frame when paced."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import numpy as np
import pytest

from companion.messages import Frame, Message, RangeSample
from companion.runtime.paced_replay import PacedFeed
from companion.runtime.pipeline import in_order_of_time

MS = 1_000_000


def frame(seq: int, t_ns: int) -> Frame:
    return Frame(seq, t_ns, np.zeros((2, 2), np.uint8), np.zeros((2, 2, 3), np.uint8))


def test_a_frame_comes_after_all_telemetry_up_to_its_time() -> None:
    samples = [RangeSample(t * MS, 1.0) for t in (0, 5, 10, 11, 30)]
    frames = [frame(0, 10 * MS), frame(1, 20 * MS)]
    merged = [(m.t_ns // MS, isinstance(m, Frame)) for m in in_order_of_time(samples, frames)]
    assert merged == [
        (0, False), (5, False), (10, False), (10, True), (11, False), (20, True), (30, False),
    ]  # fmt: skip


def test_a_slow_reader_gets_all_telemetry_and_the_latest_frame() -> None:
    messages: list[Message] = []
    for k in range(40):
        messages += [RangeSample(k * MS, float(k)), frame(k, k * MS)]
    feed = PacedFeed(messages)
    pause = threading.Event()
    seen: list[Message] = []
    for message in feed:
        seen.append(message)
        if isinstance(message, Frame):
            pause.wait(0.012)
    frames = [m.seq for m in seen if isinstance(m, Frame)]
    assert [m.t_ns for m in seen if isinstance(m, RangeSample)] == [k * MS for k in range(40)]
    assert frames == sorted(frames)
    assert frames[-1] == 39
    assert feed.n_dropped == 40 - len(frames) > 0


def test_the_sources_fault_reaches_the_reader() -> None:
    def source() -> Iterator[Message]:
        yield frame(0, 0)
        raise OSError("the disk is gone")

    with pytest.raises(OSError, match="the disk is gone"):
        list(PacedFeed(source()))


def test_leaving_early_ends_the_player() -> None:
    before = threading.active_count()
    feed = PacedFeed(frame(k, k * 50 * MS) for k in range(1000))
    for message in feed:
        assert isinstance(message, Frame)
        break
    del feed
    # the generator is closed with the loop; its player has been waited for
    assert threading.active_count() <= before + 1
