"""The only file of the package that asks the time."""

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

    def behind_ns(self) -> int:
        """By how much the system's clock has been set forward since, or the other way round."""
        return time.time_ns() - self.now_ns()

    def from_monotonic_ns(self, monotonic_ns: int) -> int:
        """The time of the flight at a time by CLOCK_MONOTONIC."""
        return monotonic_ns + self.epoch_ns


STEP = 1.02
"""Ratio of a bin's ends: a percentile is known to within one percent."""
LEAST_MS, MOST_MS = 1e-3, 1e7
"""A microsecond to some hours; what is shorter or longer counts to the first or last bin."""
N_BINS = math.ceil(math.log(MOST_MS / LEAST_MS) / math.log(STEP)) + 1


class _Durations:
    """A histogram of durations with bins of equal ratio, and their sum: as large at any length."""

    def __init__(self) -> None:
        self.counts = array("q", bytes(8 * N_BINS))
        self.n = 0
        self.total_ms = 0.0
        self.least_ms, self.most_ms = math.inf, 0.0

    def add(self, ms: float) -> None:
        place = math.log(max(ms, LEAST_MS) / LEAST_MS) / math.log(STEP)
        self.counts[min(int(place), N_BINS - 1)] += 1
        self.n += 1
        self.total_ms += ms
        self.least_ms, self.most_ms = min(self.least_ms, ms), max(self.most_ms, ms)

    def percentiles_ms(self, percents: tuple[float, ...]) -> list[float]:
        """To within one percent; between two durations linear, as numpy's are."""
        ranks = [(self.n - 1) * percent / 100 for percent in percents]
        wanted = [whole for rank in ranks for whole in (math.floor(rank), math.ceil(rank))]
        bins = np.searchsorted(np.cumsum(np.frombuffer(self.counts, np.int64)), wanted, "right")
        values = np.clip(LEAST_MS * STEP ** (bins + 0.5), self.least_ms, self.most_ms)
        shares = np.array(ranks) - wanted[::2]
        found: list[float] = (values[::2] + shares * (values[1::2] - values[::2])).tolist()
        return found


class StageTimes:
    """How long each named piece of work took, in milliseconds.

    A stage gets one and wraps its parts in `with times("features"):`; the stage itself never sees a
    clock, so its results cannot depend on one. It needs the same memory and time however long a
    flight is; may be used from any thread.
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
        """Record a duration that was measured elsewhere (an OpenCL event)."""
        with self._lock:
            self._by_name[name].add(ms)

    def total_ms(self, name: str) -> float:
        """All of it so far under one name."""
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
    """Seconds on a clock that never jumps."""
    return time.monotonic()


def since_boot_ns() -> int:
    """Time since the computer was switched on, sleep included: the same for all processes."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


def wait_s(stop: threading.Event, seconds: float) -> None:
    """Wait for a while, or until `stop` is set."""
    if seconds > 0:
        stop.wait(seconds)


def cpu_s() -> float:
    """Seconds of all processors that this process has used."""
    return time.process_time()
