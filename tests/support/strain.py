"""How much of the time this machine withholds: limits are stated for one that does not.

A thread does nothing but wake up a hundred times a second. What it comes late by in a stretch of
time is added, twice, to what the daemon is allowed then.
"""

from __future__ import annotations

import threading
import time
from types import TracebackType

TICK_S = 0.01
NORMAL_LATE_S = 0.001
FACTOR = 2.0


class Strain:
    """`with Strain() as strain`; then `strain.allowed_s(0.3, from_ns)`."""

    def __init__(self) -> None:
        self._late: list[tuple[int, float]] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._wake, name="strain", daemon=True)

    def __enter__(self) -> Strain:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self._stop.set()
        self._thread.join()

    def withheld_s(self, from_ns: int, to_ns: int) -> float:
        """How late the thread was in all between two times by CLOCK_MONOTONIC."""
        return sum(late_s for t_ns, late_s in list(self._late) if from_ns <= t_ns <= to_ns)

    def allowed_s(self, limit_s: float, from_ns: int) -> float:
        """What a limit that counts from a time becomes on this machine."""
        to_ns = from_ns + round(limit_s * 1e9)
        for _ in range(3):  # what is withheld in the time that was added counts too
            allowed_s = limit_s + FACTOR * self.withheld_s(from_ns, to_ns)
            to_ns = from_ns + round(allowed_s * 1e9)
        return allowed_s

    def _wake(self) -> None:
        while not self._stop.is_set():
            asked_s = time.monotonic() + TICK_S
            time.sleep(TICK_S)
            late_s = time.monotonic() - asked_s
            if late_s > NORMAL_LATE_S:
                self._late.append((time.monotonic_ns(), late_s))
