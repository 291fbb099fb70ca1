from __future__ import annotations

from companion.timing.stamp_filter import valid_stamps

S = 10**9


def seconds(*stamps: int) -> list[bool]:
    return valid_stamps([stamp * S for stamp in stamps], 0, 10**6 * S)


def test_single_corrupt_stamp() -> None:
    assert seconds(1, 2, 500, 3, 4) == [True, True, False, True, True]
    assert seconds(500, 1, 2, 3) == [False, True, True, True]
    assert seconds(101, 102, 103, 2) == [True, True, True, False]


def test_gap_and_clock_change() -> None:
    assert all(seconds(1, 2, 500, 501, 502))
    assert all(seconds(500, 501, 1, 2, 3))


def test_limits() -> None:
    assert seconds(-1, 1, 10**7, 2) == [False, True, False, True]


def test_few_stamps() -> None:
    assert seconds() == []
    assert seconds(7) == [True]
