"""Processor time withheld by this machine: test limits are stated for one without load.

A thread looks fifty times a second at how many want a processor and how many there are: where
twice as many want one, what is asked of the daemon may take twice as long. What the thread itself
wakes up late by counts too.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType

TICK_S = 0.02
ROUNDS = 2


class Strain:
    """`with Strain() as strain`; then `strain.allowed_s(0.3, from_ns)`."""

    def __init__(self) -> None:
        self._withheld: list[tuple[int, float]] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._look, name="strain", daemon=True)

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
        """What was withheld in all between two times by CLOCK_MONOTONIC."""
        return sum(each_s for t_ns, each_s in list(self._withheld) if from_ns <= t_ns <= to_ns)

    def allowed_s(self, limit_s: float, from_ns: int) -> float:
        """What a limit that counts from a time becomes on this machine."""
        allowed_s = limit_s
        for _ in range(ROUNDS):  # what is withheld in the time that was added counts too
            allowed_s = limit_s + self.withheld_s(from_ns, from_ns + round(allowed_s * 1e9))
        return allowed_s

    def _look(self) -> None:
        n_processors = len(os.sched_getaffinity(0))
        before_s = time.monotonic()
        while not self._stop.is_set():
            time.sleep(TICK_S)
            now_s = time.monotonic()
            too_many = max(0.0, _n_running() / n_processors - 1.0)
            withheld_s = too_many * (now_s - before_s) + max(0.0, now_s - before_s - TICK_S)
            self._withheld.append((round(now_s * 1e9), withheld_s))
            before_s = now_s


@contextmanager
def within(limit_s: float) -> Iterator[None]:
    """What is done takes no longer than so on a machine without load; else AssertionError."""
    with Strain() as strain:
        begun_ns = time.monotonic_ns()
        yield
        took_s = 1e-9 * (time.monotonic_ns() - begun_ns)
        allowed_s = strain.allowed_s(limit_s, begun_ns)
        assert took_s < allowed_s, f"took {took_s:.2f} s, of {allowed_s:.2f} s"


def _n_running() -> int:
    with open("/proc/stat") as lines:
        (line,) = (line for line in lines if line.startswith("procs_running"))
    return int(line.split()[1]) - 1  # without the thread that asks
