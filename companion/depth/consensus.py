"""What several depth maps say of the same surface: their median, where enough agree with it."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, replace

import numpy as np

from companion.depth.fusion import points_of
from companion.geometry import Array, Pose
from companion.messages import DepthMap, Floats, PixelState

AROUND = 3
"""Maps before, and as many after, that are asked about one."""
AGREEMENT = 0.025
"""Relative difference from the median up to which a map supports it."""
LEAST_SUPPORT = 2
"""Maps that must support a depth, itself included."""
LEAST_SIGMA = 0.01
"""Relative standard deviation that no map is thought to be better than: poses have errors too."""


@dataclass(frozen=True, slots=True, eq=False)
class _Placed:
    map: DepthMap
    world_from_camera: Pose


class Consensus:
    """Holds the last maps, with what was filled in; gives each back once those after it are there.

    A weakly textured surface is matched anew from each place, and errs each time otherwise: where
    maps agree, that tells more than any of them knows of itself (Merrell et al. 2007).
    """

    def __init__(self, converged_sigma: float) -> None:
        self._converged_sigma = converged_sigma
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
        placed = [
            (o.map, o.world_from_camera.inverse() @ here.world_from_camera) for o in others
        ]
        return judged(here.map, placed, self._converged_sigma)


def judged(
    depth_map: DepthMap, others: list[tuple[DepthMap, Pose]], converged_sigma: float
) -> DepthMap:
    """The map with depths and states as it and the others, each with other_from_here, have it.

    A depth that enough maps support is their median, and has converged where together they are
    sure of it; one that others see and do not support so has not. What no other sees stays as it
    is.
    """
    rows, columns = np.nonzero(depth_map.depth > 0)
    points = points_of(depth_map, rows, columns)
    n = len(points)
    off, sigma = np.zeros((len(others) + 1, n)), np.zeros((len(others) + 1, n))
    sigma[0] = depth_map.sigma[rows, columns] / points[:, 2]
    for k, (other, other_from_here) in enumerate(others, 1):
        off[k], sigma[k] = _seen(points, other, other_from_here)
    told = np.isfinite(off)
    middle = _median(off, told)
    near = told & (np.abs(off - middle) < AGREEMENT)
    support = near.sum(0)
    asked = told.sum(0) > 1
    supported = asked & (support >= LEAST_SUPPORT)
    weight = np.where(near, 1.0 / np.maximum(sigma, LEAST_SIGMA) ** 2, 0.0).sum(0)
    sure = supported & (weight * converged_sigma**2 > 1.0)
    scatter = np.where(near, (off - middle) ** 2, 0.0).sum(0) / np.maximum(support, 1)
    # the maps share images, so that their errors are not independent
    relative = np.sqrt(2.0 / np.maximum(weight, 1e-12) + scatter)
    depth, state, error = depth_map.depth.copy(), depth_map.state.copy(), depth_map.sigma.copy()
    at = rows[supported], columns[supported]
    depth[at] = points[supported, 2] * (1.0 + middle[supported])
    error[at] = points[supported, 2] * relative[supported]
    before = state[rows, columns]
    inner = before != PixelState.BORDER.value
    state[rows[sure & inner], columns[sure & inner]] = PixelState.CONVERGED.value
    unsure = asked & ~sure & (before == PixelState.CONVERGED.value)
    state[rows[unsure], columns[unsure]] = PixelState.UPDATING.value
    return replace(depth_map, depth=depth, state=state, sigma=error)


def _seen(points: Array, other: DepthMap, other_from_here: Pose) -> tuple[Array, Array]:
    """How much further away another map has each point, and its sigma, in proportion; else nan."""
    p = other_from_here.apply(points)
    fx, fy, cx, cy = other.intrinsics
    height, width = other.depth.shape
    front = p[:, 2] > 1e-6
    z = np.where(front, p[:, 2], 1.0)
    u, v = np.rint(fx * p[:, 0] / z + cx), np.rint(fy * p[:, 1] / z + cy)
    inside = front & (u >= 0) & (v >= 0) & (u < width) & (v < height)
    row, column = (np.where(inside, x, 0).astype(np.int64) for x in (v, u))
    seen = np.where(inside, other.depth[row, column], np.float32(0))
    known = seen > 0
    off = np.where(known, seen / z - 1.0, np.nan)
    return off, np.where(known, other.sigma[row, column] / np.where(known, seen, 1.0), np.inf)


def _median(values: Array, told: Floats | Array) -> Array:
    """Down columns, of what is told; the mean of the two in the middle where there are two."""
    order = np.sort(np.where(told, values, np.inf), axis=0)
    n = told.sum(0)
    at = np.arange(values.shape[1])
    lower, upper = order[(n - 1) // 2, at], order[n // 2, at]
    return np.asarray(0.5 * (lower + upper))
