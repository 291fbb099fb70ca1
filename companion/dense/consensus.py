"""Depth maps of neighbouring references checked against each other, with visibility.

What another reference measured says something about a pixel of this one only where both look at the
same piece of surface. A point of this map, seen from the other camera, lies

* at the depth measured there: the two agree;
* in front of it: the other camera looked through the point, which contradicts it;
* behind it: it is hidden there, which says nothing. A background beside an object is hidden from
  most references, and these agree on the object's depth, as they all see the object.

The converse is asked by projecting what the other measured into this image: a surface in front of
this map's point would have hidden it, and contradicts it too. (Merrell et al. 2007, "Real-time
visibility-based fusion of depth maps", call these support, free-space violation and occlusion.)
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.config import DepthConfig
from companion.dense.fusion import points_of
from companion.dense.normals import MAX_STEP
from companion.geometry.transforms import Array, Pose
from companion.messages import DepthMap, Floats, PixelState

Mask = NDArray[np.bool_]

AROUND = 3
"""Maps before, and as many after, that are asked about one."""
AGREEMENT = 0.025
"""Relative difference of depth up to which two maps may agree: a little more than the standard
deviation that a converged pixel has at most."""
CONTRADICTION_SIGMAS = 3.0
"""Standard deviations of their difference beyond which two maps contradict each other."""
LEAST_SUPPORT = 2
"""Maps that must support a depth, this one included if it has measured there."""
LEAST_CONTRADICTIONS = 2
"""Of two that contradict each other either may be wrong; two against one are believed."""
POSE_SIGMA = 0.01
"""Relative standard deviation of another reference's depth here from the poses between them, at
least: what maps differ by beyond their own is seen only where they overlap. At most `AGREEMENT`: a
map that is off by more is wrong, and others may say so."""
POSE_REACH = 0.1
"""Relative difference up to which two maps' pixels are taken for the same surface, to measure how
far poses put them apart."""
LEAST_OVERLAP_PX = 500
"""Pixels that both have converged in, of which that is measured."""
FILLED_SHARE = 0.5
"""Of `converged_sigma`, the most that a depth which converges by agreement may have: maps share
images and poses, so that they err together by more than they can tell."""
LEAST_SIGMA = 1e-4
"""Relative; keeps the weights finite."""


@dataclass(frozen=True, slots=True, eq=False)
class _Placed:
    map: DepthMap
    world_from_camera: Pose


class Consensus:
    """Holds the last maps, with what was filled in; gives each back once those after it are there.

    A weakly textured surface is matched anew from each place, and errs each time otherwise: where
    maps agree, that tells more than any of them knows of itself.
    """

    def __init__(self, config: DepthConfig) -> None:
        self._config = config
        self._held: OrderedDict[int, _Placed] = OrderedDict()
        self._waiting: list[int] = []

    def add(self, depth_map: DepthMap, world_from_camera: Pose) -> list[DepthMap]:
        """Take the next map; those that have waited long enough."""
        self._held[depth_map.keyframe_id] = _Placed(depth_map, world_from_camera)
        self._waiting.append(depth_map.keyframe_id)
        out = []
        while len(self._waiting) > AROUND:
            out.append(self._judged(self._waiting.pop(0)))
        while len(self._held) > 2 * AROUND:
            self._held.popitem(last=False)
        return out

    def flush(self) -> list[DepthMap]:
        """All that still wait."""
        out = [self._judged(keyframe_id) for keyframe_id in self._waiting]
        self._waiting.clear()
        return out

    def _judged(self, keyframe_id: int) -> DepthMap:
        here = self._held[keyframe_id]
        others = [held for key, held in self._held.items() if key != keyframe_id]
        placed = [(o.map, o.world_from_camera.inverse() @ here.world_from_camera) for o in others]
        return judged(here.map, placed, self._config)


@dataclass(frozen=True, slots=True, eq=False)
class _Statement:
    """What a map says of this one's pixels (N,): relative differences of depth, nan for nothing.

    `against` are pixels that it contradicts, whether it has another depth for them or not.
    """

    off: Array
    sigma: Array
    converged: Mask
    against: Mask


def judged(
    depth_map: DepthMap, others: list[tuple[DepthMap, Pose]], config: DepthConfig
) -> DepthMap:
    """The map with depths and states as it and the others, each with other_from_here, have it.

    Depths that maps agree on are averaged. A pixel converges by agreement only where the mean is
    far surer than a converged pixel must be, and no edge is beside it. One that has converged keeps
    its depth but for that averaging, unless no other map supports it and at least two contradict
    it: then it takes the depth that these agree on, or is "updating" again. What no other sees
    stays as it is.
    """
    rows, columns = np.nonzero(depth_map.depth > 0)
    points = points_of(depth_map, rows, columns)
    measured = _measured(depth_map, config)[rows, columns]
    sigma = (depth_map.sigma[rows, columns] / points[:, 2]).astype(np.float64)
    state = depth_map.state.copy()
    before = state[rows, columns]
    converged = before == PixelState.CONVERGED.value
    nothing = np.zeros(len(points))
    said = [_Statement(nothing, sigma, converged, nothing > 0)]
    for other, other_from_here in others:
        said.append(_statement(depth_map, points, sigma, converged, other, other_from_here, config))
    off = np.stack([s.off for s in said])
    told = np.isfinite(off)
    n_against = np.sum([s.against for s in said], axis=0)

    agree = told & (np.abs(off) < AGREEMENT)
    confirmed = converged & (agree.sum(0) >= LEAST_SUPPORT)
    middle = np.where(confirmed, 0.0, _median(off, told))
    near = told & (np.abs(off - middle) < AGREEMENT)
    near[0] &= measured  # what was filled in from around is no measurement
    supported = near.sum(0) >= LEAST_SUPPORT
    mean, relative = _mean(off, np.stack([s.sigma for s in said]), near)

    depth, error = depth_map.depth.copy(), depth_map.sigma.copy()
    at = rows[supported], columns[supported]
    depth[at] = points[supported, 2] * (1.0 + mean[supported])
    error[at] = depth[at] * relative[supported]
    sure = supported & (relative < FILLED_SHARE * config.converged_sigma)
    sure &= (near & np.stack([s.converged for s in said])).sum(0) >= LEAST_SUPPORT
    sure &= ~_beside_edge(depth)[rows, columns]
    filled = sure & (before != PixelState.BORDER.value)
    state[rows[filled], columns[filled]] = PixelState.CONVERGED.value
    moved = supported & ~near[0] & (relative >= config.converged_sigma)
    lost = converged & (moved | (~supported & (n_against >= LEAST_CONTRADICTIONS)))
    state[rows[lost], columns[lost]] = PixelState.UPDATING.value
    return replace(depth_map, depth=depth, state=state, sigma=error)


def _statement(
    here: DepthMap, points: Array, sigma: Array, converged: Mask, other: DepthMap,
    other_from_here: Pose, config: DepthConfig,
) -> _Statement:  # fmt: skip
    """What another map says of points (N, 3) of this one."""
    off, off_sigma, sure = _seen(points, other, _measured(other, config), other_from_here)
    crossing, crossing_sigma = _projected(here, points, other, other_from_here.inverse())
    pose = _pose_sigma(off[converged], np.hypot(sigma, off_sigma)[converged])
    agrees = np.abs(off) < AGREEMENT
    through = off > _apart(sigma, off_sigma, pose)
    in_front = ~agrees & (crossing < -_apart(sigma, crossing_sigma, pose))
    # a surface further away is this pixel's only where the other camera looked through the point
    elsewhere = in_front | (through & (crossing > AGREEMENT))
    value = np.where(agrees, off, np.where(elsewhere, crossing, np.nan))
    own = np.where(agrees, off_sigma, crossing_sigma)
    return _Statement(value, np.hypot(own, pose), sure | ~agrees, through | in_front)


def _pose_sigma(off: Array, sigma: Array) -> float:
    """How far, relatively, poses put two maps apart: what they differ by beyond their own sigma."""
    same = np.abs(off) < POSE_REACH
    if same.sum() < LEAST_OVERLAP_PX:
        return POSE_SIGMA
    # 1.48 times the median of |x| is a Gaussian's standard deviation
    beyond = (1.48 * np.median(np.abs(off[same]))) ** 2 - np.median(sigma[same]) ** 2
    return float(np.sqrt(np.clip(beyond, POSE_SIGMA**2, AGREEMENT**2)))


def _apart(sigma: Array, other: Array, pose: float) -> Array:
    """By how much, relatively, two depths differ at the least that contradict each other."""
    together = np.sqrt(sigma**2 + other**2 + pose**2)
    return np.asarray(np.maximum(CONTRADICTION_SIGMAS * together, AGREEMENT))


def _measured(depth_map: DepthMap, config: DepthConfig) -> Mask:
    """Pixels whose images fit, however sure their depth is; the rest was filled in from around."""
    fits = depth_map.inlier_ratio >= config.min_inlier_ratio
    unsure = (depth_map.state == PixelState.UPDATING.value) & fits
    return np.asarray((depth_map.state == PixelState.CONVERGED.value) | unsure, np.bool_)


def _seen(
    points: Array, other: DepthMap, measured: Mask, other_from_here: Pose
) -> tuple[Array, Array, Mask]:
    """How much further away another map has each point, and its sigma, in proportion; else nan.

    And where it has converged.
    """
    row, column, z, inside = _pixels(other_from_here.apply(points), other)
    known = inside & measured[row, column] & (other.depth[row, column] > 0)
    seen = np.where(known, other.depth[row, column], np.nan)
    sure = known & (other.state[row, column] == PixelState.CONVERGED.value)
    return seen / z - 1.0, other.sigma[row, column] / seen, sure


def _projected(
    here: DepthMap, points: Array, other: DepthMap, here_from_other: Pose
) -> tuple[Array, Array]:
    """What another map's converged pixels have in the pixels of points (N, 3), as `_seen`.

    The nearest of those that fall into a pixel hides the others.
    """
    known = (other.state == PixelState.CONVERGED.value) & (other.depth > 0)
    rows, columns = np.nonzero(known)
    row, column, z, inside = _pixels(here_from_other.apply(points_of(other, rows, columns)), here)
    source = np.flatnonzero(inside)
    width = here.depth.shape[1]
    # positive floats are ordered as their bits are: one minimum finds the nearest and whose it is
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


def _pixels(
    points: Array, depth_map: DepthMap
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array, Mask]:
    """Row and column of points (N, 3) in a map's image, their depth, and which lie in it."""
    fx, fy, cx, cy = depth_map.intrinsics
    height, width = depth_map.depth.shape
    front = points[:, 2] > 1e-6
    z = np.where(front, points[:, 2], 1.0)
    u, v = np.rint(fx * points[:, 0] / z + cx), np.rint(fy * points[:, 1] / z + cy)
    inside = front & (u >= 0) & (v >= 0) & (u < width) & (v < height)
    row, column = (np.where(inside, x, 0).astype(np.int64) for x in (v, u))
    return row, column, z, inside


def _mean(off: Array, sigma: Array, near: Mask) -> tuple[Array, Array]:
    """Weighted mean down columns of what is `near`, and its relative standard deviation."""
    weight = np.where(near, 1.0 / np.maximum(np.where(near, sigma, 1.0), LEAST_SIGMA) ** 2, 0.0)
    total = np.maximum(weight.sum(0), 1e-12)
    value = np.where(near, off, 0.0)
    mean = (weight * value).sum(0) / total
    scatter = (weight * np.where(near, value - mean, 0.0) ** 2).sum(0) / total
    # the maps share images, so that their errors are not independent
    return mean, np.sqrt(2.0 / total + scatter)


def _beside_edge(depth: Floats) -> Mask:
    """Pixels with another surface beside them: a map that is half a pixel off has that one."""
    window = np.ones((3, 3), np.uint8)
    far = np.asarray(cv2.dilate(depth, window), np.float32)
    near = np.asarray(cv2.erode(depth, window), np.float32)
    return np.asarray(far > (1.0 + MAX_STEP) * near, np.bool_)


def _median(values: Array, told: Mask) -> Array:
    """Down columns, of what is told; the mean of the two in the middle where there are two."""
    order = np.sort(np.where(told, values, np.inf), axis=0)
    n = told.sum(0)
    at = np.arange(values.shape[1])
    lower, upper = order[(n - 1) // 2, at], order[n // 2, at]
    return np.asarray(0.5 * (lower + upper))
