"""Health of the daemon: records of sources, stages, what is sent and the computer.

`Health` is all of it at one time; meters count it, status lines tell it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

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
    exposure_us: int | None = None
    """Of a camera whose exposure we choose; likewise `gain`, in its own steps."""
    gain: int | None = None


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
    `n_overtaken` measured poses were not sent, as predicted ones for their time had been.
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
    n_overtaken: int = 0


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
    refused: Mapping[str, int] = field(default_factory=dict)
    """Number of measurements that did not fit the body's motion in this flight, by kind."""

    def to_json(self) -> dict[str, Any]:
        """Plain types; a number that is not finite is null."""
        document = _plain(self)
        document["load"]["temperature_c"] = _plain(self.load.temperature_c)
        document["load"]["memory_share"] = _plain(self.load.memory_share)
        return dict(document)


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return {name: _plain(getattr(value, name)) for name in value.__dataclass_fields__}
    if isinstance(value, dict):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if isinstance(value, float):
        return round(value, 6) if math.isfinite(value) else None
    return value
