"""Consistency check of depth maps between neighbouring reference images, with visibility.

Another depth map is evidence on a pixel of this one only where both see the same surface. A point
of this map, seen from the other camera, lies

* at the depth measured there: support;
* in front of it: free-space violation, a contradiction;
* behind it: occlusion, no evidence. A background beside an object is occluded in most views, which
  agree on the depth of the object, as they all see it.

Conversely, measurements of the other map are projected into this image: a surface in front of a
point of this map would have occluded it, also a contradiction. (Merrell et al. 2007, "Real-time
visibility-based fusion of depth maps": support, free-space violation and occlusion.)
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.config import DepthConfig
from companion.dense.fusion import pixels_of, points_of
from companion.dense.normals import MAX_STEP
from companion.geometry.transforms import Array, Pose
from companion.messages import DepthMap, Floats, PixelState

Mask = NDArray[np.bool_]

N_NEIGHBOURS = 3
"""Maps before, and as many after, used to check one."""
AGREEMENT = 0.025
"""Largest relative depth difference of agreeing maps: a little more than the largest standard
deviation of a converged pixel."""
CONTRADICTION_SIGMAS = 3.0
"""Standard deviations of the difference beyond which two maps contradict each other."""
MIN_SUPPORT = 2
"""Maps that must support a depth, this one included if measured."""
MIN_CONTRADICTIONS = 2
"""Least number of contradicting maps: of two either may be wrong, two outvote one."""
POSE_SIGMA = 0.01
"""Lower bound of the relative depth error due to relative poses, which is measured in the overlap
of maps. At most `AGREEMENT`: a map with larger errors is wrong."""
MAX_POSE_DIFFERENCE = 0.1
"""Relative difference up to which pixels count as the same surface, to measure pose errors."""
MIN_OVERLAP_PX = 500
"""Pixels converged in both maps required for that."""
MAX_FILLED_SIGMA_RATIO = 0.5
"""Largest sigma, relative to `converged_sigma`, of pixels that converge by agreement: maps share
images and poses, so that their errors are correlated."""
MIN_SIGMA = 1e-4
"""Relative; bounds the weights."""


@dataclass(frozen=True, slots=True, eq=False)
class _PosedMap:
    map: DepthMap
    world_from_camera: Pose


class Consensus:
    """Buffers depth maps, and checks each once its successors have arrived.

    Weakly textured surfaces are matched independently in each view: agreement of maps is more
    informative than the uncertainty of any one.
    """

    def __init__(self, config: DepthConfig) -> None:
        self._config = config
        self._recent: OrderedDict[int, _PosedMap] = OrderedDict()
        self._waiting: list[int] = []

    def add(self, depth_map: DepthMap, world_from_camera: Pose) -> list[DepthMap]:
        """Add the next map; returns those that are complete."""
        self._recent[depth_map.keyframe_id] = _PosedMap(depth_map, world_from_camera)
        self._waiting.append(depth_map.keyframe_id)
        out = []
        while len(self._waiting) > N_NEIGHBOURS:
            out.append(self._checked(self._waiting.pop(0)))
        while len(self._recent) > 2 * N_NEIGHBOURS:
            self._recent.popitem(last=False)
        return out

    def flush(self) -> list[DepthMap]:
        """Check all pending maps."""
        out = [self._checked(keyframe_id) for keyframe_id in self._waiting]
        self._waiting.clear()
        return out

    def _checked(self, keyframe_id: int) -> DepthMap:
        here = self._recent[keyframe_id]
        others = [held for key, held in self._recent.items() if key != keyframe_id]
        posed = [(o.map, o.world_from_camera.inverse() @ here.world_from_camera) for o in others]
        return check_consistency(here.map, posed, self._config)


@dataclass(frozen=True, slots=True, eq=False)
class _Evidence:
    """Evidence of a map on pixels (N,) of another: relative depth differences, nan for none.

    `against` are pixels that it contradicts, with or without a depth of its own.
    """

    difference: Array
    sigma: Array
    converged: Mask
    against: Mask


def check_consistency(
    depth_map: DepthMap, others: list[tuple[DepthMap, Pose]], config: DepthConfig
) -> DepthMap:
    """Depths and states of a map updated by others, each with other_from_here.

    Agreeing depths are averaged. A pixel converges by agreement only where the mean is far more
    certain than required of a converged pixel, and off depth edges. A converged pixel keeps its
    depth but for the averaging, unless no other map supports and at least two contradict it: then
    it takes the depth on which these agree, or becomes "updating". Pixels unseen by others are
    unchanged.
    """
    rows, columns = np.nonzero(depth_map.depth > 0)
    points = points_of(depth_map, rows, columns)
    measured = _measured(depth_map, config)[rows, columns]
    sigma = (depth_map.sigma[rows, columns] / points[:, 2]).astype(np.float64)
    state = depth_map.state.copy()
    before = state[rows, columns]
    converged = before == PixelState.CONVERGED.value
    nothing = np.zeros(len(points))
    evidence = [_Evidence(nothing, sigma, converged, nothing > 0)]
    for other, other_from_here in others:
        evidence.append(
            _evidence_of(depth_map, points, sigma, converged, other, other_from_here, config)
        )
    difference = np.stack([s.difference for s in evidence])
    valid = np.isfinite(difference)
    n_against = np.sum([s.against for s in evidence], axis=0)

    agree = valid & (np.abs(difference) < AGREEMENT)
    confirmed = converged & (agree.sum(0) >= MIN_SUPPORT)
    middle = np.where(confirmed, 0.0, _median(difference, valid))
    near = valid & (np.abs(difference - middle) < AGREEMENT)
    near[0] &= measured  # filled-in pixels are no measurement
    supported = near.sum(0) >= MIN_SUPPORT
    mean, relative = _mean(difference, np.stack([s.sigma for s in evidence]), near)

    depth, error = depth_map.depth.copy(), depth_map.sigma.copy()
    at = rows[supported], columns[supported]
    depth[at] = points[supported, 2] * (1.0 + mean[supported])
    error[at] = depth[at] * relative[supported]
    sure = supported & (relative < MAX_FILLED_SIGMA_RATIO * config.converged_sigma)
    sure &= (near & np.stack([s.converged for s in evidence])).sum(0) >= MIN_SUPPORT
    sure &= ~_beside_edge(depth)[rows, columns]
    filled = sure & (before != PixelState.BORDER.value)
    state[rows[filled], columns[filled]] = PixelState.CONVERGED.value
    moved = supported & ~near[0] & (relative >= config.converged_sigma)
    lost = converged & (moved | (~supported & (n_against >= MIN_CONTRADICTIONS)))
    state[rows[lost], columns[lost]] = PixelState.UPDATING.value
    return replace(depth_map, depth=depth, state=state, sigma=error)


def _evidence_of(
    here: DepthMap, points: Array, sigma: Array, converged: Mask, other: DepthMap,
    other_from_here: Pose, config: DepthConfig,
) -> _Evidence:  # fmt: skip
    """Evidence of another map on points (N, 3) of this one."""
    difference, difference_sigma, sure = _measured_at(
        points, other, _measured(other, config), other_from_here
    )
    crossing, crossing_sigma = _projected(here, points, other, other_from_here.inverse())
    pose = _pose_sigma(difference[converged], np.hypot(sigma, difference_sigma)[converged])
    agrees = np.abs(difference) < AGREEMENT
    through = difference > _contradiction_threshold(sigma, difference_sigma, pose)
    in_front = ~agrees & (crossing < -_contradiction_threshold(sigma, crossing_sigma, pose))
    # a farther surface belongs to this pixel only where the other camera saw through the point
    elsewhere = in_front | (through & (crossing > AGREEMENT))
    value = np.where(agrees, difference, np.where(elsewhere, crossing, np.nan))
    own = np.where(agrees, difference_sigma, crossing_sigma)
    return _Evidence(value, np.hypot(own, pose), sure | ~agrees, through | in_front)


def _pose_sigma(difference: Array, sigma: Array) -> float:
    """Relative depth error due to poses: differences in excess of the sigmas."""
    same = np.abs(difference) < MAX_POSE_DIFFERENCE
    if same.sum() < MIN_OVERLAP_PX:
        return POSE_SIGMA
    # 1.48 median |x| is the standard deviation of a Gaussian
    beyond = (1.48 * np.median(np.abs(difference[same]))) ** 2 - np.median(sigma[same]) ** 2
    return float(np.sqrt(np.clip(beyond, POSE_SIGMA**2, AGREEMENT**2)))


def _contradiction_threshold(sigma: Array, other: Array, pose: float) -> Array:
    """Smallest relative difference at which two depths contradict each other."""
    together = np.sqrt(sigma**2 + other**2 + pose**2)
    return np.asarray(np.maximum(CONTRADICTION_SIGMAS * together, AGREEMENT))


def _measured(depth_map: DepthMap, config: DepthConfig) -> Mask:
    """Pixels with photo-consistent depth, converged or not; the others were filled in."""
    fits = depth_map.inlier_ratio >= config.min_inlier_ratio
    updating = (depth_map.state == PixelState.UPDATING.value) & fits
    return np.asarray((depth_map.state == PixelState.CONVERGED.value) | updating, np.bool_)


def _measured_at(
    points: Array, other: DepthMap, measured: Mask, other_from_here: Pose
) -> tuple[Array, Array, Mask]:
    """Relative excess of the depth of another map at each point, its sigma, and convergence.

    nan where it has none.
    """
    row, column, z, inside = pixels_of(other_from_here.apply(points), other)
    known = inside & measured[row, column] & (other.depth[row, column] > 0)
    seen = np.where(known, other.depth[row, column], np.nan)
    sure = known & (other.state[row, column] == PixelState.CONVERGED.value)
    return seen / z - 1.0, other.sigma[row, column] / seen, sure


def _projected(
    here: DepthMap, points: Array, other: DepthMap, here_from_other: Pose
) -> tuple[Array, Array]:
    """Converged pixels of another map projected into those of points (N, 3), as `_measured_at`.

    With z-buffering.
    """
    known = (other.state == PixelState.CONVERGED.value) & (other.depth > 0)
    rows, columns = np.nonzero(known)
    row, column, z, inside = pixels_of(here_from_other.apply(points_of(other, rows, columns)), here)
    source = np.flatnonzero(inside)
    width = here.depth.shape[1]
    # positive floats order as their bits: one minimum gives the nearest depth and its index
    bits = z[source].astype(np.float32).view(np.uint32).astype(np.uint64)
    key = np.full(here.depth.size, np.iinfo(np.uint64).max, np.uint64)
    keys = (bits << np.uint64(32)) | source.astype(np.uint64)
    np.minimum.at(key, row[source] * width + column[source], keys)
    key = key.reshape(here.depth.shape)[here.depth > 0]
    hit = key < np.iinfo(np.uint64).max
    nearest = np.where(hit, key & np.uint64(0xFFFFFFFF), 0).astype(np.int64)
    if len(source) == 0:
        return np.full(len(points), np.nan), np.full(len(points), np.nan)
    sigma = (other.sigma[rows, columns] / other.depth[rows, columns])[nearest]
    return np.where(hit, z[nearest] / points[:, 2] - 1.0, np.nan), np.where(hit, sigma, np.nan)


def _mean(difference: Array, sigma: Array, near: Mask) -> tuple[Array, Array]:
    """Weighted mean along columns of what is `near`, and its relative standard deviation."""
    weight = np.where(near, 1.0 / np.maximum(np.where(near, sigma, 1.0), MIN_SIGMA) ** 2, 0.0)
    total = np.maximum(weight.sum(0), 1e-12)
    value = np.where(near, difference, 0.0)
    mean = (weight * value).sum(0) / total
    scatter = (weight * np.where(near, value - mean, 0.0) ** 2).sum(0) / total
    # the maps share images, so that their errors are not independent
    return mean, np.sqrt(2.0 / total + scatter)


def _beside_edge(depth: Floats) -> Mask:
    """Pixels adjacent to a depth edge, which half a pixel of error would confuse."""
    window = np.ones((3, 3), np.uint8)
    far = np.asarray(cv2.dilate(depth, window), np.float32)
    near = np.asarray(cv2.erode(depth, window), np.float32)
    return np.asarray(far > (1.0 + MAX_STEP) * near, np.bool_)


def _median(values: Array, valid: Mask) -> Array:
    """Median along columns of valid values; the mean of the middle two where even."""
    order = np.sort(np.where(valid, values, np.inf), axis=0)
    n = valid.sum(0)
    at = np.arange(values.shape[1])
    lower, upper = order[(n - 1) // 2, at], order[n // 2, at]
    return np.asarray(0.5 * (lower + upper))
