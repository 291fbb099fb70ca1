"""Recent attitudes of the autopilot."""

from __future__ import annotations

from bisect import bisect_left, insort

from companion.geometry.transforms import (
    Array,
    interpolate_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
    vector_from_rotation,
)
from companion.telemetry import AttitudeSample

MAX_GAP_NS = 500_000_000
MAX_EXTRAPOLATION_NS = 120_000_000
"""Beyond, in gusts, extrapolation errs by degrees, more than prediction from images."""


class AttitudeHistory:
    """Recent attitudes of the autopilot, interpolated."""

    def __init__(
        self, keep: int = 4000, max_gap_ns: int = MAX_GAP_NS,
        max_extrapolation_ns: int = MAX_EXTRAPOLATION_NS,
    ) -> None:  # fmt: skip
        self._keep, self._max_gap_ns = keep, max_gap_ns
        self._max_extrapolation_ns = max_extrapolation_ns
        self._samples: list[AttitudeSample] = []
        self._times: list[int] = []

    def add(self, sample: AttitudeSample) -> None:
        """Add a sample; late ones are inserted in order, duplicates ignored."""
        if not self._times or sample.t_ns > self._times[-1]:
            self._times.append(sample.t_ns)
            self._samples.append(sample)
        else:
            at = bisect_left(self._times, sample.t_ns)
            if self._times[at] == sample.t_ns:
                return
            insort(self._times, sample.t_ns)
            self._samples.insert(at, sample)
        if len(self._times) > 2 * self._keep:
            del self._times[: -self._keep], self._samples[: -self._keep]

    @property
    def newest_t_ns(self) -> int:
        """Time of the last sample; 0 before the first."""
        return self._times[-1] if self._times else 0

    def with_rates_at(self, t_ns: int, step_ns: int) -> tuple[Array, Array] | None:
        """`ned_from_body` (3, 3) and mean body rates (3,), rad/s, over a step before and after."""
        here = self.at(t_ns)
        before, after = self.at(t_ns - step_ns), self.at(t_ns + step_ns)
        if here is None or before is None or after is None:
            return None
        return here, vector_from_rotation(before.T @ after) / (2e-9 * step_ns)

    def at(self, t_ns: int) -> Array | None:
        """Rotation `ned_from_body` (3, 3) at a time; None where no sample is near enough."""
        if not self._times:
            return None
        i = bisect_left(self._times, t_ns)
        if 0 < i < len(self._times):
            before, after = self._samples[i - 1], self._samples[i]
            span = after.t_ns - before.t_ns
            if span > self._max_gap_ns:
                return None
            return interpolate_rotation(
                rotation_from_quaternion(before.ned_from_body),
                rotation_from_quaternion(after.ned_from_body),
                (t_ns - before.t_ns) / span,
            )
        nearest = self._samples[0] if i == 0 else self._samples[-1]
        gap_ns = t_ns - nearest.t_ns
        if abs(gap_ns) > self._max_extrapolation_ns:
            return None
        rotation = rotation_from_quaternion(nearest.ned_from_body)
        if nearest.rates_body_rad_s is None:
            return rotation
        rotated: Array = rotation @ rotation_from_vector(nearest.rates_body_rad_s * (gap_ns * 1e-9))
        return rotated
