"""Stamps that damage made wild, told apart from gaps and from clocks that were set."""

from __future__ import annotations

from collections.abc import Sequence

MAX_BACK_NS, MAX_AHEAD_NS = 2_000_000_000, 60_000_000_000

MAX_BOOT_NS = 366 * 86_400 * 10**9
"""No autopilot runs for longer than this."""


def believable(stamps_ns: Sequence[int], least_ns: int, most_ns: int) -> list[bool]:
    """Which stamps of a log, in its order, are true.

    A stamp is that follows the one before; one that jumps is where the next goes on from there,
    for a gap or a clock that was set; others are damaged, as are all outside of the limits.
    """
    out = [least_ns <= stamp_ns <= most_ns for stamp_ns in stamps_ns]
    inside = [number for number, good in enumerate(out) if good]
    latest_ns: int | None = None
    for place, number in enumerate(inside):
        stamp_ns = stamps_ns[number]
        if latest_ns is None or not _follows(latest_ns, stamp_ns):
            chain = [stamps_ns[later] for later in inside[place : place + 2]]
            alone = latest_ns is not None and len(chain) < 2
            if alone or not all(map(_follows, chain, chain[1:])):
                out[number] = False
                continue
        latest_ns = stamp_ns
    return out


def _follows(before_ns: int, stamp_ns: int) -> bool:
    return -MAX_BACK_NS <= stamp_ns - before_ns <= MAX_AHEAD_NS
