"""The only file of the package that asks the time, and only to measure how long things take."""

from __future__ import annotations

import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

import numpy as np

Timer = Callable[[str], AbstractContextManager[None]]
"""What a stage is handed to have its parts timed, without knowing a clock."""


class StageTimes:
    """How long each named piece of work took, in milliseconds.

    A stage gets one and wraps its parts in `with times("features"):`; the stage itself never sees a
    clock, so its results cannot depend on one.
    """

    def __init__(self) -> None:
        self._ms: defaultdict[str, list[float]] = defaultdict(list)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Time the body of a with statement under `name`."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self._ms[name].append((time.perf_counter() - start) * 1e3)

    def add(self, name: str, ms: float) -> None:
        """Record a duration that was measured elsewhere (an OpenCL event)."""
        self._ms[name].append(ms)

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
