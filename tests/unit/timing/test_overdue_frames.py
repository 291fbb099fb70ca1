"""Notices of frames that do not come: when, for which time, and for how long."""

from __future__ import annotations

import numpy as np
import pytest

from companion.messages import NO_PICTURE, Frame, FrameOverdue, Message
from companion.telemetry import HeightSample
from companion.timing.overdue_frames import LONGEST_NS, N_INTERVALS, OverdueFrames, with_notices

MS = 1_000_000
LATENCY_MS = 30
NONE = np.zeros((0, 0), np.uint8)


def frame(seq: int, t_ms: int) -> Frame:
    return Frame(seq, t_ms * MS, NONE, np.zeros((0, 0, 3), np.uint8))


def flown(period_ms: int, n: int = 40) -> OverdueFrames:
    """Frames up to one that comes at time zero."""
    overdue = OverdueFrames()
    for k in range(n):
        came_ms = (k - n + 1) * period_ms
        assert overdue.due(came_ms * MS) is None
        overdue.came(frame(k, came_ms - LATENCY_MS), came_ms * MS)
    return overdue


def noticed_ms(overdue: OverdueFrames, until_ms: int, every_ms: int = 1) -> list[int]:
    told = [overdue.due(now * MS) for now in range(0, until_ms, every_ms)]
    found = [each for each in told if each is not None]
    assert all(each.seq > NO_PICTURE for each in found)
    assert len({each.seq for each in found}) == len(found)
    return [each.t_ns // MS for each in found]


def test_notices_are_a_period_apart_and_of_the_time_of_exposure() -> None:
    assert noticed_ms(flown(50), 300) == [130 - LATENCY_MS + 50 * k for k in range(4)]


@pytest.mark.parametrize(("period_ms", "first_ms"), [(20, 130), (100, 170), (500, 850)])
def test_a_slow_camera_has_more_time(period_ms: int, first_ms: int) -> None:
    assert noticed_ms(flown(period_ms), 1000)[0] == first_ms - LATENCY_MS


def test_none_is_given_before_the_period_is_known() -> None:
    assert noticed_ms(flown(50, N_INTERVALS), 300) == []
    assert noticed_ms(flown(50, N_INTERVALS + 1), 300) != []


def test_they_end_with_the_next_frame() -> None:
    overdue = flown(50)
    assert noticed_ms(overdue, 200) == [100, 150]
    overdue.came(frame(40, 200 - LATENCY_MS), 200 * MS)
    assert overdue.due(201 * MS) is None


def test_they_are_rare_after_half_a_minute() -> None:
    found = noticed_ms(flown(50), 2 * LONGEST_NS // MS, 10)
    last_ms = LONGEST_NS // MS - LATENCY_MS + 50
    assert set(np.diff([t for t in found if t < last_ms])) == {50}
    assert set(np.diff([t for t in found if t > last_ms])) == {1000}


def test_who_asks_late_gets_one() -> None:
    overdue = flown(50)
    assert overdue.due(1000 * MS) is not None
    assert overdue.due(1001 * MS) is None


def test_a_recording_has_them_in_order_of_time() -> None:
    frames: list[Message] = [frame(k, 50 * k) for k in range(60) if not 40 <= k < 44]
    heights: list[Message] = [HeightSample(k * 10 * MS, 1.0) for k in range(300)]
    given = sorted(frames + heights, key=lambda m: m.t_ns)
    found = list(with_notices(given))
    times = [m.t_ns for m in found]
    assert times == sorted(times)
    assert [m.t_ns // MS for m in found if isinstance(m, FrameOverdue)] == [2080, 2130, 2180]
    assert [m for m in found if not isinstance(m, FrameOverdue)] == given
