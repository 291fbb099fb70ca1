"""How the daemon is: what each source and stage does, and what comes of it.

Meters count while the work goes on, in whatever thread does it; they ask no clock, every time is
handed in. What they report is frozen: `SourceHealth`, `StageHealth`, and all of it as `Health`.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from dataclasses import dataclass
from typing import Literal

WINDOW_S = 5.0
"""Rates and latencies are those of the last so many seconds."""
MAX_EVENTS = 2048
"""More events than this in a window are not kept; rates are then of a shorter time."""
MIN_BETWEEN_LINES_S = 1.0
"""Changes are told at once, but no more often than this, whatever flaps."""

SourceState = Literal["missing", "opening", "running", "silent", "frozen", "ended"]


@dataclass(frozen=True, slots=True)
class SourceHealth:
    """A camera or a link. `age_s` is the time since something last came, None if nothing ever did.

    `detail` is for people and may hold numbers.
    """

    name: str
    state: SourceState = "missing"
    rate_hz: float = 0.0
    n: int = 0
    n_dropped: int = 0
    n_reopened: int = 0
    age_s: float | None = None
    detail: str = ""


@dataclass(frozen=True, slots=True)
class StageHealth:
    """A piece of the pipeline. Latency counts from exposure to result; None where nothing came."""

    name: str
    alive: bool = True
    rate_hz: float = 0.0
    latency_p50_ms: float | None = None
    latency_p95_ms: float | None = None
    n: int = 0
    n_dropped: int = 0
    n_restarted: int = 0
    detail: str = ""


class RateMeter:
    """How often something happens, over the last few seconds."""

    def __init__(self, window_s: float = WINDOW_S) -> None:
        self._window_ns = round(window_s * 1e9)
        self._times_ns: deque[int] = deque(maxlen=MAX_EVENTS)
        self._lock = threading.Lock()

    def add(self, t_ns: int) -> None:
        """It happened."""
        with self._lock:
            self._times_ns.append(t_ns)

    def hz(self, now_ns: int) -> float:
        """Its rate; falls to 0 within the window where nothing happens any more."""
        with self._lock:
            times = [t for t in self._times_ns if now_ns - t <= self._window_ns]
            n_kept = len(self._times_ns)
        if len(times) == n_kept and n_kept > 1:  # what is kept is younger than the window
            return (n_kept - 1) * 1e9 / max(now_ns - times[0], 1)
        return len(times) * 1e9 / self._window_ns


class SourceMeter:
    """Counts what comes from a source; may be used from any thread."""

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
        """Something came at this time, the time of receipt."""
        self.n += 1
        self._last_ns = t_ns
        self._rate.add(t_ns)

    def health(self, now_ns: int) -> SourceHealth:
        """As it stands now."""
        last_ns = self._last_ns
        return SourceHealth(
            name=self.name,
            state=self.state,
            rate_hz=self._rate.hz(now_ns),
            n=self.n,
            n_dropped=self.n_dropped,
            n_reopened=self.n_reopened,
            age_s=None if last_ns is None else (now_ns - last_ns) * 1e-9,
            detail=self.detail,
        )


class StageMeter:
    """Counts what a stage does; may be used from any thread."""

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
        """A result came out at this time; what it is of was exposed or begun at `begun_ns`."""
        self.n += 1
        self._rate.add(t_ns)
        if begun_ns is not None:
            self._latency.add(t_ns, (t_ns - begun_ns) * 1e-6)

    def health(self, now_ns: int) -> StageHealth:
        """As it stands now."""
        return StageHealth(
            name=self.name,
            alive=self.alive,
            rate_hz=self._rate.hz(now_ns),
            latency_p50_ms=self._latency.percentile_ms(50, now_ns),
            latency_p95_ms=self._latency.percentile_ms(95, now_ns),
            n=self.n,
            n_dropped=self.n_dropped,
            n_restarted=self.n_restarted,
            detail=self.detail,
        )


class LatencyMeter:
    """How long something takes, over the last few seconds; for the delay of the event loop too."""

    def __init__(self, window_s: float = WINDOW_S) -> None:
        self._window_ns = round(window_s * 1e9)
        self._events: deque[tuple[int, float]] = deque(maxlen=MAX_EVENTS)
        self._lock = threading.Lock()

    def add(self, t_ns: int, ms: float) -> None:
        """It took so long, and was over at this time."""
        with self._lock:
            self._events.append((t_ns, ms))

    def percentile_ms(self, percent: float, now_ns: int) -> float | None:
        """Of so many percent it took no longer; None where there were none."""
        with self._lock:
            recent = sorted(ms for t, ms in self._events if now_ns - t <= self._window_ns)
        if not recent:
            return None
        return recent[max(0, math.ceil(percent / 100 * len(recent)) - 1)]
