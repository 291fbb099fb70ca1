"""Clocks and durations: the only file of the package that reads the time."""

from __future__ import annotations

import math
import threading
import time
from array import array
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

import numpy as np

Timer = Callable[[str], AbstractContextManager[None]]
"""Times a named part of a stage, which itself reads no clock."""


class FlightClock:
    """Clock of a live flight: monotonic, offset to the Unix time at construction.

    It resembles Unix time and never jumps, however the system clock is set meanwhile.
    """

    def __init__(self, epoch_ns: int | None = None) -> None:
        self.epoch_ns = time.time_ns() - time.monotonic_ns() if epoch_ns is None else epoch_ns
        """Unix time of the zero of the monotonic clock, as known at construction."""

    def now_ns(self) -> int:
        """Current time."""
        return time.monotonic_ns() + self.epoch_ns

    def behind_ns(self) -> int:
        """Time by which the system clock has been set forward since."""
        return time.time_ns() - self.now_ns()

    def from_monotonic_ns(self, monotonic_ns: int) -> int:
        """Flight time of a CLOCK_MONOTONIC time."""
        return monotonic_ns + self.epoch_ns


STEP = 1.02
"""Ratio of bin limits: percentiles are accurate to one per cent."""
MIN_MS, MAX_MS = 1e-3, 1e7
"""A microsecond to some hours; values beyond count to the first or last bin."""
N_BINS = math.ceil(math.log(MAX_MS / MIN_MS) / math.log(STEP)) + 1


class _Durations:
    """Histogram of durations with logarithmic bins, and their sum; of constant size."""

    def __init__(self) -> None:
        self.counts = array("q", bytes(8 * N_BINS))
        self.n = 0
        self.total_ms = 0.0
        self.min_ms, self.max_ms = math.inf, 0.0

    def add(self, ms: float) -> None:
        position = math.log(max(ms, MIN_MS) / MIN_MS) / math.log(STEP)
        self.counts[min(int(position), N_BINS - 1)] += 1
        self.n += 1
        self.total_ms += ms
        self.min_ms, self.max_ms = min(self.min_ms, ms), max(self.max_ms, ms)

    def percentiles_ms(self, percents: tuple[float, ...]) -> list[float]:
        """Accurate to one per cent; interpolated linearly, as in numpy."""
        ranks = [(self.n - 1) * percent / 100 for percent in percents]
        wanted = [whole for rank in ranks for whole in (math.floor(rank), math.ceil(rank))]
        bins = np.searchsorted(np.cumsum(np.frombuffer(self.counts, np.int64)), wanted, "right")
        values = np.clip(MIN_MS * STEP ** (bins + 0.5), self.min_ms, self.max_ms)
        shares = np.array(ranks) - wanted[::2]
        found: list[float] = (values[::2] + shares * (values[1::2] - values[::2])).tolist()
        return found


class StageTimes:
    """Durations of named parts of the work, in milliseconds.

    A stage wraps its parts in `with times("features"):` and reads no clock, so that its results
    cannot depend on one. Memory and time are independent of the length of a flight; thread-safe.
    """

    def __init__(self) -> None:
        self._by_name: defaultdict[str, _Durations] = defaultdict(_Durations)
        self._lock = threading.Lock()

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Time the body of a with statement under `name`."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.add(name, (time.perf_counter() - start) * 1e3)

    def add(self, name: str, ms: float) -> None:
        """Record a duration measured elsewhere (an OpenCL event)."""
        with self._lock:
            self._by_name[name].add(ms)

    def total_ms(self, name: str) -> float:
        """Total so far under a name."""
        with self._lock:
            return self._by_name[name].total_ms if name in self._by_name else 0.0

    def summary(self) -> dict[str, dict[str, float]]:
        """Per name: n, p50_ms and p95_ms (to within one percent), total_s."""
        out = {}
        with self._lock:
            for name, durations in sorted(self._by_name.items()):
                p50_ms, p95_ms = durations.percentiles_ms((50, 95))
                out[name] = {
                    "n": durations.n, "p50_ms": round(p50_ms, 3), "p95_ms": round(p95_ms, 3),
                    "total_s": round(durations.total_ms / 1e3, 3),
                }  # fmt: skip
        return out


def monotonic_s() -> float:
    """Seconds of a monotonic clock."""
    return time.monotonic()


def since_boot_ns() -> int:
    """Time since boot, sleep included: the same for all processes."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


def wait_s(stop: threading.Event, seconds: float) -> None:
    """Wait for a time, or until `stop` is set."""
    if seconds > 0:
        stop.wait(seconds)


def thread_s() -> float:
    """CPU seconds used by this thread."""
    return time.thread_time()
