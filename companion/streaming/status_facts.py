"""Status of the companion as numbers and words by name, for plots and the status panel.

Unknown values are left out.
"""

from __future__ import annotations

from collections import deque
from typing import Any

from companion.health import Health
from companion.messages import MapUpdate, Track, Warned
from companion.streaming.items import Shown
from companion.telemetry import FIELDS, TELEMETRY, Telemetry

CURVES = {kind: f"telemetry/{kind.schema.name}" for kind in TELEMETRY if kind.schema.curve}
"""Name of the fact, and of the plot, of telemetry that has a curve."""
RATE_OVER_NS = 2_000_000_000
RECENT_NS = 30_000_000_000
"""Time for which a warning is shown."""
MOST_WARNINGS = 3


class StatusFacts:
    """Newest values of the status, collected from messages."""

    def __init__(self) -> None:
        self.shown = Shown.WAITING
        self.health: Health | None = None
        self.height_m: float | None = None
        self.speed_m_s: float | None = None
        self._tracked: deque[int] = deque(maxlen=1024)
        self._n_points: dict[int, int] = {}
        self._n_points_in_all = 0
        self._update: MapUpdate | None = None
        self._warned: dict[str, int] = {}
        self._measured: dict[str, float] = {}
        self._t_ns = 0

    def tracked(self, track: Track) -> None:
        """Take the track of a frame."""
        self._t_ns = max(self._t_ns, track.t_ns)
        if track.map_from_camera is not None:
            self._tracked.append(track.t_ns)
        while self._tracked and self._tracked[0] < self._t_ns - RATE_OVER_NS:
            self._tracked.popleft()

    def points_came(self, keyframe_id: int, n: int) -> None:
        """Take the number of points of a keyframe."""
        self._n_points_in_all += n - self._n_points.get(keyframe_id, 0)
        self._n_points[keyframe_id] = n

    def mapped(self, update: MapUpdate) -> None:
        """Take a new map."""
        self._update = update

    def warned(self, warning: Warned) -> None:
        """Take a warning."""
        if not warning.good:
            self._warned.pop(warning.what, None)
            self._warned[warning.what] = warning.t_ns

    def measured(self, sample: Telemetry) -> None:
        """Take telemetry."""
        kind = type(sample)
        if kind in CURVES:
            self._measured[CURVES[kind]] = getattr(sample, FIELDS[kind][0].name)

    def facts(self, quality: int) -> dict[str, Any]:
        """All values by name; telemetry once, so that a curve ends with its sensor."""
        measured, self._measured = self._measured, {}
        found = self._update.georeference if self._update is not None else None
        span_ns = self._tracked[-1] - self._tracked[0] if len(self._tracked) > 1 else 0
        recent = [w for w, t in self._warned.items() if t > self._t_ns - RECENT_NS]
        facts: dict[str, Any] = {
            "state": self.shown.value,
            "quality": quality if quality >= 0 else None,
            "scale": found.method if found is not None else None,
            "scale_m": found.world_from_map.scale if found is not None else None,
            "sigma_scale": found.sigma_scale if found is not None else None,
            "has_origin": found.has_origin if found is not None else None,
            "height_m": self.height_m,
            "speed_m_s": self.speed_m_s,
            "rate_hz": (len(self._tracked) - 1) * 1e9 / span_ns if span_ns else None,
            "n_keyframes": self._update.n_keyframes if self._update is not None else None,
            "n_points": self._n_points_in_all or None,
            "warnings": recent[-MOST_WARNINGS:] or None,
            **measured,
        }
        if self.health is not None:
            facts.update(_of_health(self.health))
        return {name: _short(value) for name, value in facts.items() if value is not None}


def _of_health(health: Health) -> dict[str, Any]:
    feedback = health.feedback
    gone = [f"{s.name} {s.state}" for s in health.sources if s.state != "running"]
    gone += [f"{stage.name} down" for stage in health.stages if not stage.alive]
    return {
        "latency_ms": health.pose_latency_p95_ms,
        "cpu_share": health.load.cpu_share,
        "temperature_c": health.load.temperature_c,
        "memory_share": health.load.memory_share,
        "disk_free_gib": health.load.disk_free_mib / 1024
        if health.load.disk_free_mib is not None else None,
        "feedback": feedback.mode if feedback.mode != "off" else None,
        "sending": feedback.sending if feedback.mode != "off" else None,
        "why_not": feedback.why_not or None,
        "reduced": health.degraded or None,
        "gone": gone or None,
    }  # fmt: skip


def _short(value: Any) -> Any:
    return float(f"{value:.4g}") if isinstance(value, float) else value
