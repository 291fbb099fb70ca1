"""Detection of corrupt stamps, as opposed to gaps and clock changes, and of these."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

MAX_BACK_NS, MAX_AHEAD_NS = 2_000_000_000, 60_000_000_000

MAX_BOOT_NS = 366 * 86_400 * 10**9
"""Longest plausible time since boot."""
AHEAD_NS, SETTLED_NS = 500_000_000, 5_000_000_000
"""Messages are delayed anew by less than this; a link that stalls catches up within that."""


def valid_stamps(stamps_ns: Sequence[int], min_ns: int, max_ns: int) -> list[bool]:
    """Mask of valid stamps of a log, in its order.

    A stamp is valid if it continues from the one before, or if the next one continues from it,
    after a gap or clock change; also within the limits.
    """
    out = [min_ns <= stamp_ns <= max_ns for stamp_ns in stamps_ns]
    inside = [number for number, good in enumerate(out) if good]
    latest_ns: int | None = None
    for index, number in enumerate(inside):
        stamp_ns = stamps_ns[number]
        if latest_ns is None or not _plausible_step(latest_ns, stamp_ns):
            chain = [stamps_ns[later] for later in inside[index : index + 2]]
            alone = latest_ns is not None and len(chain) < 2
            if alone or not all(map(_plausible_step, chain, chain[1:])):
                out[number] = False
                continue
        latest_ns = stamp_ns
    return out


def _plausible_step(before_ns: int, stamp_ns: int) -> bool:
    return -MAX_BACK_NS <= stamp_ns - before_ns <= MAX_AHEAD_NS


def steps_ahead_ns(one_way: Sequence[tuple[int, int, int]]) -> list[int]:
    """Steps of the receiver's clock ahead of the autopilot's, from which no later message is back.

    `one_way` (N, 3): remote, receive in ns, segment between reboots, in order of arrival.
    """
    table = np.asarray(one_way, np.int64).reshape(-1, 3)
    out: list[int] = []
    for segment in np.unique(table[:, 2]):
        remote, receive = table[table[:, 2] == segment, :2].T
        late = receive - remote
        least_later = np.minimum.accumulate(late[:0:-1])[::-1]  # a stalled link catches up
        step = np.minimum(np.diff(late), least_later - late[:-1])
        goes_on = remote[-1] - remote[:-1] > SETTLED_NS
        out += step[goes_on & (step > AHEAD_NS)].tolist()
    return out
