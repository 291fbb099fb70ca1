"""Scale of a map from a rangefinder, and from changes of barometric height."""

from __future__ import annotations

import numpy as np

from companion.estimation.georeference.alignment_sample import AlignmentSample
from companion.estimation.georeference.range_climb import climb_scale
from companion.estimation.georeference.trajectory_alignment import Scale, reconciled
from companion.estimation.sample_series import SampleSeries
from companion.geometry.transforms import Array, Pose
from companion.telemetry import HeightSample, RangeSample, Telemetry

MIN_RANGES = 4
"""Ranges required for a median."""
SIGMA_RANGE_SCALE, SIGMA_HEIGHT_SCALE = 0.02, 0.05
"""Lower bounds of the relative scale error by rangefinder and barometer. By ranges alone it was
0.1, 0.5, 0.5 and 4 % on rendered flights with cameras 45, 80, 90 and 30 degrees down: 2 % RMS."""
SIGMA_RANGE_OFFSET_M, NEAR_RATIO = 0.08, 0.5
"""Height of the rangefinder above or below the camera, which nobody states: near the ground it
counts for most, so that only the greater ranges count."""


class HeightScales:
    """Collects ranges and heights; the scale of a map by each, on request.

    A barometric height counts from a climb of `min_travel_m` on.
    """

    def __init__(self, min_travel_m: float, body_from_camera: Pose | None) -> None:
        self._min_travel_m = min_travel_m
        self._body_from_camera = body_from_camera
        self._height = SampleSeries()
        self._range = SampleSeries()

    def take(self, sample: Telemetry) -> None:
        """Add a sample; irrelevant ones are ignored."""
        if isinstance(sample, HeightSample):
            self._height.add(sample.t_ns, np.array([-sample.height_m]))
        elif isinstance(sample, RangeSample):
            self._range.add(sample.t_ns, np.array([sample.distance_m]))

    def prune(self, before_ns: int, keyframes_ns: Array) -> None:
        """Drop samples before a time, except at the times of keyframes (N,), sorted."""
        self._height.prune(before_ns, keyframes_ns)
        self._range.prune(before_ns, keyframes_ns)

    @property
    def has_ranges(self) -> bool:
        """True if there are enough ranges to compare with a map."""
        return len(self._range) >= MIN_RANGES

    def of(self, samples: list[AlignmentSample], level: Array | None) -> list[Scale]:
        """One of each sensor that knows it: by ranges to mapped ground; in a level map by climbs.

        `level` is the rotation (3, 3) world_from_map by attitude, None where unknown.
        """
        found, by_height = self._by_range(samples), None
        if level is not None:
            by_climb, by_height = self._by_climb(samples, level), self._by_height(samples, level)
            found = found if by_climb is None else reconciled(found, by_climb)
        return [scale for scale in (found, by_height) if scale is not None]

    def _by_range(self, samples: list[AlignmentSample]) -> Scale | None:
        """Scale from rangefinder against mapped ground."""
        if not self.has_ranges:
            return None
        distance, ok = self._range.at(np.array([p.t_ns for p in samples]))
        seen = np.array([
            (d[0], p.ground_units)
            for p, d, good in zip(samples, distance, ok, strict=True)
            if good and p.ground_units is not None
        ]).reshape(-1, 2)  # fmt: skip
        high = seen[seen[:, 0] >= NEAR_RATIO * seen[:, 0].max(initial=0.0)]
        if len(high) < MIN_RANGES:
            return None
        ratios = high[:, 0] / high[:, 1]
        scale = float(np.median(ratios))
        spread = 1.4826 * float(np.median(np.abs(ratios - scale))) / scale
        offset = SIGMA_RANGE_OFFSET_M / float(np.median(high[:, 0]))
        sigma = float(max(spread / np.sqrt(len(ratios)), np.hypot(SIGMA_RANGE_SCALE, offset)))
        return Scale(scale, sigma, "rangefinder", len(ratios))

    def _by_climb(self, samples: list[AlignmentSample], level: Array) -> Scale | None:
        """Scale from rangefinder on a way straight up or down, over whatever is below."""
        if not self.has_ranges:
            return None
        distance, ok = self._range.at(np.array([p.t_ns for p in samples]))
        seen = [
            (level @ p.map_from_camera.translation, d[0] * self._steepness(p.ned_from_camera))
            for p, d, good in zip(samples, distance, ok, strict=True)
            if good and p.ned_from_camera is not None
        ]
        if len(seen) < MIN_RANGES:
            return None
        return climb_scale(np.array([place for place, _ in seen]), np.array([h for _, h in seen]))

    def _steepness(self, ned_from_camera: Array) -> float:
        """Cosine of the body's tilt, by which a range along its axis is longer than a height."""
        if self._body_from_camera is None:
            return 1.0
        return float((ned_from_camera @ self._body_from_camera.rotation.T)[2, 2])

    def _by_height(self, samples: list[AlignmentSample], level: Array) -> Scale | None:
        """Scale from changes of barometric height."""
        if len(self._height) < 4:
            return None
        t_ns = np.array([p.t_ns for p in samples])
        down, ok = self._height.at(t_ns)
        if ok.sum() < 4:
            return None
        mapped = np.stack([level @ p.map_from_camera.translation for p in samples])[ok, 2]
        a, b = mapped - mapped.mean(), down[ok, 0] - down[ok, 0].mean()
        if float(np.ptp(b)) < self._min_travel_m:
            return None
        scale = float((a * b).sum() / max(float((a * a).sum()), 1e-12))
        if scale <= 0:
            return None
        size_m = float(np.sqrt(max(float((b * b).sum()), 1e-9)))
        sigma = max((0.5 + float(np.std(b - scale * a))) / size_m, SIGMA_HEIGHT_SCALE)
        return Scale(scale, sigma, "barometric height", int(ok.sum()))
