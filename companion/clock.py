"""The only file of the package that asks the time."""

from __future__ import annotations

import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

import numpy as np

Timer = Callable[[str], AbstractContextManager[None]]
"""What a stage is handed to have its parts timed, without knowing a clock."""


class FlightClock:
    """The time of a live flight: monotonic, counted from the Unix time at which this was made.

    It looks like Unix time and never jumps, whatever is done to the system's clock meanwhile.
    """

    def __init__(self, epoch_ns: int | None = None) -> None:
        self.epoch_ns = time.time_ns() - time.monotonic_ns() if epoch_ns is None else epoch_ns
        """Unix time at which the monotonic clock was zero, as far as was known."""

    def now_ns(self) -> int:
        """Now."""
        return time.monotonic_ns() + self.epoch_ns

    def from_monotonic_ns(self, monotonic_ns: int) -> int:
        """The time of the flight at a time by CLOCK_MONOTONIC."""
        return monotonic_ns + self.epoch_ns


class StageTimes:
    """How long each named piece of work took, in milliseconds.

    A stage gets one and wraps its parts in `with times("features"):`; the stage itself never sees a
    clock, so its results cannot depend on one.
    """

    def __init__(self) -> None:
        self._ms: defaultdict[str, list[float]] = defaultdict(list)
        self._total_ms: defaultdict[str, float] = defaultdict(float)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Time the body of a with statement under `name`."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.add(name, (time.perf_counter() - start) * 1e3)

    def add(self, name: str, ms: float) -> None:
        """Record a duration that was measured elsewhere (an OpenCL event)."""
        self._ms[name].append(ms)
        self._total_ms[name] += ms

    def total_ms(self, name: str) -> float:
        """All of it so far under one name."""
        return self._total_ms[name]

    def summary(self) -> dict[str, dict[str, float]]:
        """Per name: n, p50_ms, p95_ms, total_s."""
        return {
            name: {
                "n": len(ms),
                "p50_ms": round(float(np.percentile(ms, 50)), 3),
                "p95_ms": round(float(np.percentile(ms, 95)), 3),
                "total_s": round(float(np.sum(ms)) / 1e3, 3),
            }
            for name, ms in sorted(self._ms.items())
        }


def monotonic_s() -> float:
    """Seconds on a clock that never jumps."""
    return time.monotonic()


def wait_s(stop: threading.Event, seconds: float) -> None:
    """Wait for a while, or until `stop` is set."""
    if seconds > 0:
        stop.wait(seconds)


def cpu_s() -> float:
    """Seconds of all processors that this process has used."""
    return time.process_time()
