"""Facts of a run that its report states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from companion.config import MEASUREMENTS, Measurement
from companion.geometry.camera import Camera
from companion.geometry.geodesy import GeoOrigin
from companion.messages import ClockReport


@dataclass(frozen=True, slots=True, eq=False)
class RunFacts:
    """Facts of a run beside its messages; `stage_times` is `StageTimes.summary()`.

    `origin` is the geodetic origin of local NED. `completed` is False when the run was stopped.
    """

    stage_times: Mapping[str, Mapping[str, float]]
    wall_s: float
    clock: ClockReport | None
    origin: GeoOrigin | None
    device: str
    config: Mapping[str, Any]
    versions: Mapping[str, str]
    command: str
    peak_memory_mb: float
    camera: Camera
    n_frames_total: int
    completed: bool
    dropped: Mapping[str, int] = field(default_factory=dict)
    rates_hz: Mapping[str, float] = field(default_factory=dict)
    believed: tuple[Measurement, ...] = MEASUREMENTS
    """Telemetry that could decide about the pose, by `telemetry.use`."""
