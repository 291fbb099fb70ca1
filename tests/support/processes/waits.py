"""What code under test costs its thread: how often that waited, and its longest processor time.

    waits = Waits()
    for packet in packets:
        with waits:
            wire.write(packet)
    assert waits.n <= RECLAIMS

Neither is longer on a machine that has much else to do, as the time by the clock is. A thread that
waits, for a peer, a lock or an interval however short, gives the processor up of its own accord,
which the kernel counts (getrusage(2), voluntary context switches).
"""

from __future__ import annotations

import resource
import time
from types import TracebackType

RECLAIMS = 2
"""Waits that are the kernel's own: for a page of memory, where that is short."""


class Waits:
    """See above."""

    def __init__(self) -> None:
        self.n = 0
        """Times that the thread gave the processor up."""
        self.longest_busy_s = 0.0
        """Most processor time of the thread in one go,"""
        self.busy_s = 0.0
        """and all of it."""
        self._before = 0
        self._begun_s = 0.0

    def __enter__(self) -> None:
        self._before = _n_waited()
        self._begun_s = time.thread_time()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        busy_s = time.thread_time() - self._begun_s
        self.longest_busy_s = max(self.longest_busy_s, busy_s)
        self.busy_s += busy_s
        self.n += _n_waited() - self._before


def _n_waited() -> int:
    return resource.getrusage(resource.RUSAGE_THREAD).ru_nvcsw
