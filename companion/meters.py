"""Meters of sources and stages: counts, rates and latencies of the last few seconds.

They count while the work goes on, in whatever thread does it, and ask no clock: every time is
handed in.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Sequence

from companion.health import SourceHealth, SourceState, StageHealth

WINDOW_S = 5.0
"""Window of rates and latencies."""
MAX_EVENTS = 2048
"""Most events in a window; beyond it rates are of a shorter time."""


class RateMeter:
    """Rate of events over the last few seconds."""

    def __init__(self, window_s: float = WINDOW_S) -> None:
        self._window_ns = round(window_s * 1e9)
        self._times_ns: deque[int] = deque(maxlen=MAX_EVENTS)
        self._lock = threading.Lock()

    def add(self, t_ns: int) -> None:
        """Count an event."""
        with self._lock:
            self._times_ns.append(t_ns)

    def hz(self, now_ns: int) -> float:
        """Rate; falls to 0 within the window after the last event."""
        times_ns, begin_ns = self._times_ns, now_ns - self._window_ns
        with self._lock:
            while len(times_ns) > 1 and times_ns[1] < begin_ns:
                times_ns.popleft()
            n_old = bool(times_ns) and times_ns[0] < begin_ns
            n_kept = len(times_ns)
            if not n_old and n_kept > 1:  # what is kept is younger than the window
                return (n_kept - 1) * 1e9 / max(now_ns - times_ns[0], 1)
        return (n_kept - n_old) * 1e9 / self._window_ns


class SourceMeter:
    """Counters of a source; may be used from any thread."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.state: SourceState = "missing"
        self.detail = ""
        self.n = 0
        self.n_dropped = 0
        self.n_reopened = 0
        self._last_ns: int | None = None
        self._rate = RateMeter()

    def came(self, t_ns: int) -> None:
        """Count an input at its time of receipt."""
        self.n += 1
        self._last_ns = t_ns
        self._rate.add(t_ns)

    def health(self, now_ns: int) -> SourceHealth:
        """Health now."""
        last_ns = self._last_ns
        return SourceHealth(
            name=self.name, state=self.state, rate_hz=self._rate.hz(now_ns), n=self.n,
            n_dropped=self.n_dropped, n_reopened=self.n_reopened,
            age_s=None if last_ns is None else (now_ns - last_ns) * 1e-9, detail=self.detail,
        )  # fmt: skip


class StageMeter:
    """Counters of a stage; may be used from any thread."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.alive = False
        self.detail = ""
        self.n = 0
        self.n_dropped = 0
        self.n_restarted = 0
        self._rate = RateMeter()
        self._latency = LatencyMeter()

    def done(self, t_ns: int, begun_ns: int | None = None) -> None:
        """Count a result; its input was exposed or begun at `begun_ns`."""
        self.n += 1
        self._rate.add(t_ns)
        if begun_ns is not None:
            self._latency.add(t_ns, (t_ns - begun_ns) * 1e-6)

    def health(self, now_ns: int) -> StageHealth:
        """Health now."""
        p50_ms, p95_ms, p99_ms = self._latency.percentiles_ms((50, 95, 99), now_ns)
        return StageHealth(
            name=self.name, alive=self.alive, rate_hz=self._rate.hz(now_ns), latency_p50_ms=p50_ms,
            latency_p95_ms=p95_ms, latency_p99_ms=p99_ms, n=self.n, n_dropped=self.n_dropped,
            n_restarted=self.n_restarted, detail=self.detail,
        )  # fmt: skip


class LatencyMeter:
    """Percentiles of durations over the last few seconds; of the event loop's delay, too."""

    def __init__(self, window_s: float = WINDOW_S) -> None:
        self._window_ns = round(window_s * 1e9)
        self._events: deque[tuple[int, float]] = deque(maxlen=MAX_EVENTS)
        self._lock = threading.Lock()

    def add(self, t_ns: int, ms: float) -> None:
        """Add a duration that ended at this time."""
        with self._lock:
            self._events.append((t_ns, ms))

    def percentile_ms(self, percent: float, now_ns: int) -> float | None:
        """Percentile of the durations; None without any."""
        return self.percentiles_ms((percent,), now_ns)[0]

    def percentiles_ms(self, percents: Sequence[float], now_ns: int) -> list[float | None]:
        """Percentiles of the durations; None without any."""
        with self._lock:
            while self._events and now_ns - self._events[0][0] > self._window_ns:
                self._events.popleft()
            recent = sorted([ms for _, ms in self._events])
        if not recent:
            return [None] * len(percents)
        n = len(recent)
        return [recent[max(0, math.ceil(percent / 100 * n) - 1)] for percent in percents]
