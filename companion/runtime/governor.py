"""Load governor: load levels for a computer that is too busy or too hot, in a fixed order.

First the viewer is reduced, then the dense map, then features; on the ground the viewer keeps its
pictures while a step of the setup needs them. The pose has priority: the last level gives it less
work per frame, not fewer frames. One level at a time, each with time to take
effect before the next. With hysteresis: a level is lowered after some time with headroom, and later
each time that this turns out to have been too early.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

MAX_POSE_LATENCY_MS = 60.0
"""From the arrival of a frame to its pose, 95th percentile: cameras are 10 to 60 ms late by
themselves, which less work does not change."""
HEADROOM_LATENCY_SHARE = 0.75
NEARLY_LATE_SHARE = 0.9
SEVERE_LATENCY_SHARE = 2.0
FULL_CPU_SHARE = 0.97
"""A full processor is harmless by itself (the dense map takes the rest), but makes a pose that is
nearly late a late one."""
FULL_MEMORY_SHARE = 0.92
HEADROOM_MEMORY_SHARE = 0.85
MAX_DROPPED_HZ = 1.0
"""Frames dropped by localisation."""
COOLER_C = 5.0
"""Temperature below the limit at which it counts as cool again."""
SEVERE_C = 7.0
"""Temperature above the limit at which processors throttle themselves."""
OVERLOADED_S = 1.0
"""Least duration of an overload: one second of initialisation or a joining viewer is ignored."""
SETTLE_S = 2.0
SETTLE_HEAT_S = 15.0
SETTLE_SEVERE_S = 1.0
RECOVERY_S = 10.0
MAX_RECOVERY_S = 160.0
FORGET_S = 300.0


@dataclass(frozen=True, slots=True)
class Level:
    """Work allowed at one level. `dense_share` of keyframes get a depth map."""

    number: int
    viewer: bool = True
    dense_share: float = 1.0
    feature_share: float = 1.0

    @property
    def left_out(self) -> str:
        """Work left out, in words; "" for none."""
        parts = (("viewer", not self.viewer), ("dense map", not self.dense_share))
        off = " and ".join(name for name, is_off in parts if is_off)
        words = [f"{off} off"] if off else []
        if 0 < self.dense_share < 1:
            words.append("dense map reduced")
        if self.feature_share < 1:
            words.append("fewer features")
        return ", ".join(words)


LEVELS = (
    Level(0),
    Level(1, viewer=False),
    Level(2, viewer=False, dense_share=0.5),
    Level(3, viewer=False, dense_share=0.0),
    Level(4, viewer=False, dense_share=0.0, feature_share=0.6),
)


@dataclass(frozen=True, slots=True)
class LoadSample:
    """Measured load of about the last second; None where unknown.

    A longer window would judge a level by the time before it.
    """

    cpu_share: float | None = None
    memory_share: float | None = None
    temperature_c: float | None = None
    pose_latency_p95_ms: float | None = None
    pose_dropped_hz: float = 0.0


class Governor:
    """Chooses the level; to be called about once a second."""

    def __init__(self, hot_c: float, max_pose_latency_ms: float = MAX_POSE_LATENCY_MS) -> None:
        self._hot_c = hot_c
        self._max_latency_ms = max_pose_latency_ms
        self._level = LEVELS[0]
        self.keeps_viewer = False
        """True while somebody needs its pictures, whatever the level."""
        self.makes_depth = True
        """False where there is no dense map to reduce: its levels would only cost time."""
        self.why = ""
        """Reason of the present level, in words."""
        self._raised_ns: int | None = None
        self._lowered_ns: int | None = None
        self._headroom_since_ns: int | None = None
        self._recovery_s = RECOVERY_S
        self._overloaded_since_ns: int | None = None

    @property
    def level(self) -> Level:
        """Work allowed now."""
        level = self._level if self.makes_depth else replace(self._level, dense_share=1.0)
        return replace(level, viewer=True) if self.keeps_viewer else level

    @property
    def degraded(self) -> str:
        """Work left out, and the reason; "" where nothing is."""
        left_out = self.level.left_out
        return f"{left_out}, {self.why}" if left_out else ""

    def step(self, t_ns: int, sample: LoadSample) -> bool:
        """Take a measurement; whether the level has changed."""
        why, settle_s = self._overload(sample)
        if why:
            self._headroom_since_ns = None
            if self._overloaded_since_ns is None:
                self._overloaded_since_ns = t_ns
            if t_ns - self._overloaded_since_ns < OVERLOADED_S * 1e9:
                return False
            return self._raise(t_ns, why, settle_s)
        self._overloaded_since_ns = None
        if not self._has_headroom(sample):
            self._headroom_since_ns = None
            return False
        if self._headroom_since_ns is None:
            self._headroom_since_ns = t_ns
        if self._level.number and t_ns - self._headroom_since_ns >= self._recovery_s * 1e9:
            self._lower(t_ns)
            return True
        return False

    def _raise(self, t_ns: int, why: str, settle_s: float) -> bool:
        if self._level is LEVELS[-1]:
            return False
        if self._raised_ns is not None and t_ns - self._raised_ns < settle_s * 1e9:
            return False
        if self._lowered_ns is not None:
            # Soon after a step back: that was too early, the next one waits longer.
            soon = t_ns - self._lowered_ns < 2 * self._recovery_s * 1e9
            forgotten = t_ns - self._lowered_ns > FORGET_S * 1e9
            if soon:
                self._recovery_s = min(2 * self._recovery_s, MAX_RECOVERY_S)
            elif forgotten:
                self._recovery_s = RECOVERY_S
            self._lowered_ns = None
        self._level, self.why = self._others(LEVELS[self._level.number :])[0], why
        self._raised_ns = t_ns
        return True

    def _lower(self, t_ns: int) -> None:
        self._level = self._others(LEVELS[: self._level.number])[-1]
        self._lowered_ns = self._headroom_since_ns = t_ns
        if not self._level.number:
            self.why = ""

    def _others(self, levels: tuple[Level, ...]) -> list[Level]:
        """Those of `levels` that allow other work than the present one; of equal ones the first."""
        seen = [self._work_of(self._level)]
        out = []
        for level in levels:
            if self._work_of(level) not in seen:
                seen.append(self._work_of(level))
                out.append(level)
        return out

    def _work_of(self, level: Level) -> tuple[bool, float, float]:
        return level.viewer, level.dense_share * self.makes_depth, level.feature_share

    def _overload(self, sample: LoadSample) -> tuple[str, float]:
        """Reason of an overload, and seconds for a level to take effect; "" for none."""
        latency_ms, limit_ms = sample.pose_latency_p95_ms, self._max_latency_ms
        if latency_ms is not None and latency_ms > limit_ms:
            severe = latency_ms > SEVERE_LATENCY_SHARE * limit_ms
            return (
                f"since poses take {latency_ms:.0f} ms",
                SETTLE_SEVERE_S if severe else SETTLE_S,
            )
        if sample.pose_dropped_hz > MAX_DROPPED_HZ:
            return f"since {sample.pose_dropped_hz:.0f} frames/s go without a pose", SETTLE_S
        if (
            latency_ms is not None
            and latency_ms > NEARLY_LATE_SHARE * limit_ms
            and sample.cpu_share is not None
            and sample.cpu_share > FULL_CPU_SHARE
        ):
            return f"since the processor is full and poses take {latency_ms:.0f} ms", SETTLE_S
        if sample.temperature_c is not None and sample.temperature_c >= self._hot_c:
            severe = sample.temperature_c >= self._hot_c + SEVERE_C
            return (
                f"since it is {sample.temperature_c:.0f} C hot",
                SETTLE_S if severe else SETTLE_HEAT_S,
            )
        if sample.memory_share is not None and sample.memory_share > FULL_MEMORY_SHARE:
            return f"since memory is {100 * sample.memory_share:.0f} % full", SETTLE_S
        return "", 0.0

    def _has_headroom(self, sample: LoadSample) -> bool:
        latency_ms = sample.pose_latency_p95_ms
        return (
            (latency_ms is None or latency_ms < HEADROOM_LATENCY_SHARE * self._max_latency_ms)
            and sample.pose_dropped_hz <= 0.2 * MAX_DROPPED_HZ
            and (sample.temperature_c is None or sample.temperature_c < self._hot_c - COOLER_C)
            and (sample.memory_share is None or sample.memory_share < HEADROOM_MEMORY_SHARE)
        )
