"""Scale of a map from depths that a second camera or a depth camera measured.

Map points seen where a depth was measured have one in the map, too: the ratio is the scale.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from companion.estimation.georeference.trajectory_alignment import Scale
from companion.geometry.transforms import Array
from companion.slam.features.view import View
from companion.slam.map.sparse_map import SlamMap
from companion.telemetry import DepthSample

NEAR_PX = 3.0
"""From a measured pixel to a map point's: both are of corners, which two detectors place so."""
MIN_RATIOS = 8
"""In one image."""
MAX_PENDING = 4096
"""Depths that wait for their image; one that was dropped never comes."""
SIGMA_CALIBRATION = 0.005
"""Of focal lengths and baseline, or of a depth camera's own scale."""
COMMON_RATIO = 0.5
"""Part of one depth's standard deviation that all share: of the two cameras' angle to each other,
calibrated to a tenth of a pixel where a match is good to two."""
MAD_TO_SIGMA = 1.4826


class _Seen(NamedTuple):
    """Metres per unit of a keyframe by one image, with relative standard deviations."""

    ratio: float
    sigma: float
    sigma_common: float


class DepthScales:
    """Collects depths, compares them with tracked images; the scale of a map on request."""

    def __init__(self) -> None:
        self._pending: deque[DepthSample] = deque(maxlen=MAX_PENDING)
        self._seen: dict[int, _Seen] = {}
        """The last image of each keyframe that had enough depths."""

    def take(self, sample: DepthSample) -> None:
        """Add a depth, before its image is tracked; one that has none is ignored."""
        if sample.depth_m > 0 and sample.sigma_m > 0:
            self._pending.append(sample)

    def compare(self, view: View, slam_map: SlamMap, keyframe_id: int) -> None:
        """Compare a tracked image, relative to a keyframe, with the depths of its time."""
        depths = []
        while self._pending and self._pending[0].t_ns <= view.t_ns:
            sample = self._pending.popleft()
            if sample.t_ns == view.t_ns:
                depths.append(sample)
        mapped = np.flatnonzero(view.point_ids >= 0)
        if len(depths) < MIN_RATIOS or len(mapped) < MIN_RATIOS:
            return
        measured = np.array([(s.u_px, s.v_px, s.depth_m, s.sigma_m) for s in depths])
        away_px, near = cKDTree(view.features.pixels[mapped]).query(measured[:, :2])
        points = slam_map.positions[view.point_ids[mapped[near]]]
        depth = view.camera_from_map.apply(points)[:, 2]
        ok = (away_px < NEAR_PX) & (depth > 0)
        if np.count_nonzero(ok) < MIN_RATIOS:
            return
        sigmas = measured[ok, 3] / measured[ok, 2]
        ratio, sigma = _weighted_median(np.log(measured[ok, 2] / depth[ok]), sigmas)
        unit = slam_map.unit_of.get(keyframe_id, 1.0)
        common = COMMON_RATIO * float(np.median(sigmas))
        self._seen[keyframe_id] = _Seen(float(np.exp(ratio)) * unit, sigma, common)

    def of(self, slam_map: SlamMap) -> Scale | None:
        """The scale of a map; None where no image of it had depths."""
        keys = [k for k in (*slam_map.keyframes, *slam_map.retired) if k in self._seen]
        if not keys:
            return None
        seen = [self._seen[k] for k in keys]
        units = np.array([slam_map.unit_of.get(k, 1.0) for k in keys])
        logs = np.log([each.ratio for each in seen] / units)
        scale, spread = _weighted_median(logs, np.array([each.sigma for each in seen]))
        common = float(np.median([each.sigma_common for each in seen]))
        sigma = float(np.linalg.norm([spread, common, SIGMA_CALIBRATION]))
        return Scale(float(np.exp(scale)), sigma, "measured depths", len(keys))


def _weighted_median(values: Array, sigmas: Array) -> tuple[float, float]:
    """Median (N,) weighted by information, and its standard deviation.

    By the spread of the values or by what is stated, whichever is more.
    """
    order = np.argsort(values)
    weights = sigmas[order] ** -2
    passed = np.cumsum(weights)
    median = float(values[order][np.searchsorted(passed, 0.5 * passed[-1])])
    spread = MAD_TO_SIGMA * float(np.median(np.abs(values - median)))
    n_effective = float(passed[-1] ** 2 / (weights**2).sum())
    return median, max(spread / np.sqrt(n_effective), float(passed[-1]) ** -0.5)
