"""Health of the daemon: meters of sources and stages, and their report.

Meters count while the work goes on, in whatever thread does it; they ask no clock, every time is
handed in. What they report is frozen: `SourceHealth`, `StageHealth`, and all of it as `Health`.
"""

from __future__ import annotations

import dataclasses
import math
import threading
from collections import deque
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

WINDOW_S = 5.0
"""Window of rates and latencies."""
MAX_EVENTS = 2048
"""Most events in a window; beyond it rates are of a shorter time."""
MIN_BETWEEN_LINES_S = 1.0
"""Least interval of lines about changes."""

SourceState = Literal["missing", "opening", "running", "silent", "frozen", "ended", "driver fault"]
"""State of a source; `driver fault` is a bug of this program, whose traceback is in the journal."""


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
    """A stage. Latency is from exposure to result; None without results."""

    name: str
    alive: bool = True
    rate_hz: float = 0.0
    latency_p50_ms: float | None = None
    latency_p95_ms: float | None = None
    n: int = 0
    n_dropped: int = 0
    n_restarted: int = 0
    detail: str = ""
    latency_p99_ms: float | None = None
    waiting_mb: float = 0.0
    """Messages that wait for the stage."""


@dataclass(frozen=True, slots=True)
class FeedbackHealth:
    """Poses sent to the autopilot, or why none are.

    `why_not` is one of a few constant phrases, by which a change is detected; numbers belong in
    `detail`. Latency is from exposure to sending. With `bridging` poses go by dead reckoning.
    """

    mode: str = "off"
    sending: bool = False
    why_not: str = ""
    detail: str = ""
    rate_hz: float = 0.0
    latency_p50_ms: float | None = None
    latency_p95_ms: float | None = None
    n_sent: int = 0
    n_resets: int = 0
    bridging: bool = False


@dataclass(frozen=True, slots=True)
class FlowHealth:
    """Optical flow sent to the autopilot; `why_not` says why the last frame has none."""

    message: str = "off"
    sending: bool = False
    why_not: str = ""
    rate_hz: float = 0.0
    quality: int = 0
    latency_p50_ms: float | None = None
    n_sent: int = 0


@dataclass(frozen=True, slots=True)
class LandingHealth:
    """Landing marker sent to the autopilot; `why_not` says why the last frame is not."""

    marker: str = "off"
    sending: bool = False
    why_not: str = ""
    rate_hz: float = 0.0
    distance_m: float | None = None
    latency_p50_ms: float | None = None
    n_sent: int = 0


@dataclass(frozen=True, slots=True)
class ProcessLoad:
    """One of our processes. `cpu_cores` is 1.5 where it keeps one and a half cores busy."""

    name: str
    pid: int
    cpu_cores: float
    memory_mib: float


@dataclass(frozen=True, slots=True)
class ComputerLoad:
    """Load of this computer. Shares are 0 to 1; unknown values are None."""

    uptime_s: float = 0.0
    cpu_share: float | None = None
    core_shares: tuple[float, ...] = ()
    gpu_share: float | None = None
    temperatures_c: Mapping[str, float] = field(default_factory=dict)
    """By name of the sensor."""
    fans_rpm: tuple[int, ...] = ()
    memory_used_mib: float | None = None
    memory_total_mib: float | None = None
    disk_kind: str = ""
    """hdd, ssd, emmc or sd: the disk of the flights; "" where unknown."""
    disk_used_mib: float | None = None
    disk_total_mib: float | None = None
    disk_free_mib: float | None = None
    """Space available to us, which is less than total minus used."""
    processes: tuple[ProcessLoad, ...] = ()

    @property
    def temperature_c(self) -> float | None:
        """Highest temperature."""
        return max(self.temperatures_c.values(), default=None)

    @property
    def memory_share(self) -> float | None:
        """Share of memory in use."""
        if self.memory_used_mib is None or not self.memory_total_mib:
            return None
        return self.memory_used_mib / self.memory_total_mib


@dataclass(frozen=True, slots=True)
class Health:
    """Health at one time. `tracker` is in plain words; `quality` 1 to 100, -1 while lost."""

    t_ns: int
    uptime_s: float = 0.0
    sources: tuple[SourceHealth, ...] = ()
    stages: tuple[StageHealth, ...] = ()
    tracker: str = "waiting for the camera"
    quality: int = -1
    scale: str = ""
    """Source of the metric scale, in words; "" without one."""
    pose_latency_p95_ms: float | None = None
    feedback: FeedbackHealth = field(default_factory=FeedbackHealth)
    flight: str = ""
    """Name of the current flight; "" between flights."""
    load: ComputerLoad = field(default_factory=ComputerLoad)
    degradation: int = 0
    """Load level, 0 is everything; see companion.runtime.governor."""
    degraded: str = ""
    """Work left out and the reason, in words."""
    loop_delay_p99_ms: float | None = None
    n_warnings: Mapping[str, int] = field(default_factory=dict)
    """Number of warnings since the start, by kind."""
    set_by_ground: Mapping[str, Any] = field(default_factory=dict)
    """Keys of the configuration set over MAVLink, and their values."""
    flow: FlowHealth = field(default_factory=FlowHealth)
    landing: LandingHealth = field(default_factory=LandingHealth)
    global_position: FeedbackHealth = field(default_factory=FeedbackHealth)
    """Of the positions in latitude and longitude; `detail` is their standard deviation."""

    def to_json(self) -> dict[str, Any]:
        """Plain types; a number that is not finite is null."""
        document = _plain(dataclasses.asdict(self))
        document["load"]["temperature_c"] = _plain(self.load.temperature_c)
        document["load"]["memory_share"] = _plain(self.load.memory_share)
        document["line"] = self.line()
        return dict(document)

    def line(self) -> str:
        """One line for the journal, the most important first."""
        parts = [self._pose(), self._feedback(), self._flow(), self._landing(), self._global()]
        parts += [_source(source) for source in self.sources]
        parts += [_stage(stage) for stage in self.stages if not stage.alive or stage.n_restarted]
        parts.append(self._computer())
        if self.degraded:
            parts.append(f"reduced: {self.degraded}")
        parts.append(f"flight {self.flight}" if self.flight else "no flight")
        return "; ".join(part for part in parts if part)

    def key(self) -> Hashable:
        """Equal as long as nothing has changed that deserves a line at once."""
        return (
            self.tracker,
            bool(self.scale),
            tuple((source.name, source.state, source.n_reopened) for source in self.sources),
            tuple((stage.name, stage.alive, stage.n_restarted) for stage in self.stages),
            (self.feedback.mode, self.feedback.sending, self.feedback.why_not),
            (self.flow.message, self.flow.sending),
            (self.landing.marker, self.landing.sending),
            (self.global_position.mode, self.global_position.sending),
            self.flight,
            self.degradation,
        )

    def _pose(self) -> str:
        text = self.tracker
        if self.quality > 0:
            text += f", quality {self.quality}"
        if self.pose_latency_p95_ms is not None:
            text += f", {self.pose_latency_p95_ms:.0f} ms"
        return text + ("" if self.scale else ", no scale")

    def _feedback(self) -> str:
        feedback = self.feedback
        if feedback.mode == "off":
            return "feedback off"
        if feedback.sending:
            by = " by dead reckoning" if feedback.bridging else ""
            return f"feedback {feedback.rate_hz:.0f}/s{by}"
        return f"no feedback: {feedback.why_not or 'not yet'}" + _in_brackets(feedback.detail)

    def _flow(self) -> str:
        flow = self.flow
        if flow.message == "off":
            return ""
        if flow.sending:
            return f"flow {flow.rate_hz:.0f}/s"
        return f"no flow: {flow.why_not or 'not yet'}"

    def _landing(self) -> str:
        if self.landing.marker == "off":
            return ""
        if self.landing.sending:
            return f"landing marker {self.landing.rate_hz:.0f}/s"
        return f"no landing marker: {self.landing.why_not or 'not yet'}"

    def _global(self) -> str:
        given = self.global_position
        if given.mode == "off":
            return ""
        if given.sending:
            return f"global position {given.rate_hz:.0f}/s" + _in_brackets(given.detail)
        return f"no global position: {given.why_not or 'not yet'}"

    def _computer(self) -> str:
        load = self.load
        parts = []
        if load.cpu_share is not None:
            parts.append(f"cpu {100 * load.cpu_share:.0f} %")
        if load.memory_share is not None:
            parts.append(f"memory {100 * load.memory_share:.0f} %")
        if load.temperature_c is not None:
            parts.append(f"{load.temperature_c:.0f} C")
        if load.disk_free_mib is not None:
            parts.append(f"disk {load.disk_free_mib / 1024:.1f} GiB free")
        return ", ".join(parts)


class StatusLines:
    """Schedule of status lines: at intervals, and at once after a change."""

    def __init__(self, every_s: float) -> None:
        self._every_ns = round(every_s * 1e9)
        self._key: Hashable = None
        self._last_ns: int | None = None

    def step(self, health: Health) -> str | None:
        """Line that is due now, or None; to be called several times a second."""
        since_ns = None if self._last_ns is None else health.t_ns - self._last_ns
        if since_ns is not None and since_ns < self._every_ns:
            if health.key() == self._key or since_ns < MIN_BETWEEN_LINES_S * 1e9:
                return None
        self._key, self._last_ns = health.key(), health.t_ns
        return health.line()


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


def _source(source: SourceHealth) -> str:
    text = f"{source.name} "
    if source.state == "running":
        text += f"{source.rate_hz:.0f}/s"
    elif source.state == "silent" and source.age_s is not None:
        text += f"silent for {source.age_s:.0f} s"
    else:
        text += source.state + _in_brackets(source.detail)
    return text + (f" ({source.n_dropped} dropped)" if source.n_dropped else "")


def _stage(stage: StageHealth) -> str:
    if not stage.alive:
        return f"{stage.name} down" + _in_brackets(stage.detail)
    return f"{stage.name} restarted {stage.n_restarted} x"


def _in_brackets(detail: str) -> str:
    return f" ({detail})" if detail else ""


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if isinstance(value, float):
        return round(value, 6) if math.isfinite(value) else None
    return value
