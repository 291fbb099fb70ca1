"""Readout of a rolling shutter by what the images show, where it is not known or stated wrongly.

Two tracked frames some tenths of a second apart see the same map points. Between those of a rolling
shutter they move not only by the motion of the camera, but also by

    readout * (s_now f_now - s_before f_before)

where s is the place of a row in the image, -1/2 at the top to 1/2 at the bottom, and f how fast its
ray moves in the image by the angular rate of the camera (both brought into the second frame). The
readout is solved for together with the motion between both frames, by least squares with Huber's
weights. The map itself is no measure: its points have taken the same errors in.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from companion.geometry.transforms import Array, Pose, rotation_from_vector
from companion.slam.features.orb_features import Ints
from companion.slam.features.view import View

SPAN_NS, MAX_SPAN_NS = 200_000_000, 500_000_000
"""Between the frames of a pair: in this time a drone turns at another rate, and still sees most of
the same. From 0.1 to 0.4 s the readout comes out within 2 ms."""
SPACING_NS = 100_000_000
"""Between pairs: nearer ones have the same errors."""
MIN_POINTS = 40
ROUNDS = 2
HUBER = 2.0
BLOCK_NS = 1_000_000_000
"""Errors are taken to be independent from one second to the next."""
MIN_BLOCKS = 8
MIN_BLOCK_RATIO = 0.02
"""Information of a block that counts, of the best one's: most of a flight is hardly any turn."""


MAX_BLOCKS = 600
MAX_READOUT_S = 0.2
"""A pair that gives more has measured nothing."""


class ReadoutEstimate(NamedTuple):
    """Readout and its standard deviation, s; negative where rows come from the bottom up."""

    readout_s: float
    sigma_s: float


class _Seen(NamedTuple):
    """N points in a frame: ids, rays, their place by row, depths, rates of their rays; the pose."""

    t_ns: int
    ids: Ints
    normalised: Array
    whitening: Array
    place: Array
    depth: Array
    rates: Array
    camera_from_map: Pose


class ReadoutEstimator:
    """Collects pairs of tracked frames of a camera with images of `height` rows."""

    def __init__(self, height: int) -> None:
        self._height = height
        self._recent: deque[_Seen] = deque()
        self._next_ns = 0
        self._blocks: dict[int, tuple[float, float]] = {}
        """Sums of a second: of information, 1/s2, and of it times the readout."""

    def reset(self) -> None:
        """Drop the last frames: another map has other points."""
        self._recent.clear()

    def take(self, view: View, positions: Array, rates_rad_s: Array) -> None:
        """Add a tracked frame, with all points (P, 3) of the map, and its angular rate (3,)."""
        seen = self._seen(view, positions, rates_rad_s)
        while self._recent and seen.t_ns - self._recent[0].t_ns > MAX_SPAN_NS:
            self._recent.popleft()
        before = next((s for s in reversed(self._recent) if seen.t_ns - s.t_ns >= SPAN_NS), None)
        self._recent.append(seen)
        if before is None or seen.t_ns < self._next_ns:
            return
        self._next_ns = seen.t_ns + SPACING_NS
        found = _readout(before, seen)
        if found is not None:
            information, readout_s = found
            block = seen.t_ns // BLOCK_NS
            total, weighted = self._blocks.get(block, (0.0, 0.0))
            self._blocks[block] = total + information, weighted + information * readout_s
            self._keep_best()

    @property
    def estimate(self) -> ReadoutEstimate | None:
        """The readout; None while the camera has turned too little.

        Its standard deviation is by how much seconds differ, not less than what pixels give.
        """
        blocks = np.array(list(self._blocks.values())).reshape(-1, 2)
        blocks = blocks[blocks[:, 0] > MIN_BLOCK_RATIO * blocks[:, 0].max(initial=0.0)]
        if len(blocks) < MIN_BLOCKS:
            return None
        information, weighted = blocks.T
        total = information.sum()
        readout_s = float(weighted.sum() / total)
        n = len(blocks)
        spread = ((weighted - readout_s * information) ** 2).sum() * n / (n - 1)
        return ReadoutEstimate(readout_s, float(np.sqrt(spread / total**2 + 1.0 / total)))

    def _seen(self, view: View, positions: Array, rates_rad_s: Array) -> _Seen:
        index = np.flatnonzero(view.point_ids >= 0)
        ids = view.point_ids[index]
        features = view.features
        normalised = features.normalised if view.normalised is None else view.normalised
        whitening = features.whitening if view.whitening is None else view.whitening
        rays = np.column_stack([normalised[index], np.ones(len(index))])
        moving = -np.cross(rates_rad_s, rays)  # as the world turns the other way
        place = features.pixels[index, 1] / (self._height - 1) - 0.5
        return _Seen(
            view.t_ns, ids, normalised[index], whitening[index], place,
            view.camera_from_map.apply(positions[ids])[:, 2],
            moving[:, :2] - rays[:, :2] * moving[:, 2:], view.camera_from_map,
        )  # fmt: skip

    def _keep_best(self) -> None:
        """Bound the number of blocks: those in which the camera turned most stay."""
        if len(self._blocks) > MAX_BLOCKS:
            del self._blocks[min(self._blocks, key=lambda k: self._blocks[k][0])]


def _readout(before: _Seen, now: _Seen) -> tuple[float, float] | None:
    """Information, 1/s2, and readout, s, by the points that two frames share; None with too few."""
    _, a, b = np.intersect1d(before.ids, now.ids, return_indices=True)
    good = before.depth[a] > 0
    a, b = a[good], b[good]
    if len(a) < MIN_POINTS:
        return None
    depth = before.depth[a][:, None]
    relative = now.camera_from_map @ before.camera_from_map.inverse()
    rotation, translation, readout_s = relative.rotation, relative.translation, 0.0
    shift_before = before.rates[a] * before.place[a][:, None]
    shift_now = now.rates[b] * now.place[b][:, None]
    information = 0.0
    for _ in range(ROUNDS):
        rays = np.column_stack([before.normalised[a] - readout_s * shift_before, np.ones(len(a))])
        p = (rays * depth) @ rotation.T + translation
        if p[:, 2].min() <= 0:
            return None
        by_point = _projection_jacobian(p)
        by_rotation = -np.matmul(by_point, _skew(p))
        # points of the frame before move against their shift there
        moved = np.column_stack([-shift_before * depth, np.zeros(len(a))]) @ rotation.T
        by_readout = shift_now[..., None] + np.matmul(by_point, moved[..., None])
        expected = p[:, :2] / p[:, 2:] + readout_s * shift_now
        jacobian = np.matmul(
            now.whitening[b], np.concatenate([by_rotation, by_point, by_readout], 2)
        )
        error = np.matmul(now.whitening[b], (now.normalised[b] - expected)[..., None])[..., 0]
        weight = np.minimum(1.0, HUBER / np.maximum(np.linalg.norm(error, axis=1), 1e-9))
        weighted = jacobian * weight[:, None, None]
        normal = np.einsum("nij,nik->jk", weighted, jacobian)
        right = np.einsum("nij,ni->j", weighted, error)
        try:
            step = np.linalg.solve(normal, right)
            of_motion = np.linalg.solve(normal[:6, :6], normal[:6, 6])
        except np.linalg.LinAlgError:
            return None
        turn = rotation_from_vector(step[:3])
        rotation, translation = turn @ rotation, turn @ translation + step[3:6]
        readout_s += float(step[6])
        information = float(normal[6, 6] - normal[6, :6] @ of_motion)
    if not (np.isfinite(readout_s) and information > 0):
        return None
    return information, float(np.clip(readout_s, -MAX_READOUT_S, MAX_READOUT_S))


def _projection_jacobian(points: Array) -> Array:
    """Derivative (N, 2, 3) of normalised coordinates by points (N, 3)."""
    x, y, z = points.T
    out = np.zeros((len(points), 2, 3))
    out[:, 0, 0] = out[:, 1, 1] = 1.0 / z
    out[:, 0, 2], out[:, 1, 2] = -x / z**2, -y / z**2
    return out


def _skew(vectors: Array) -> Array:
    """Matrices (N, 3, 3) of the cross product from the left."""
    x, y, z = vectors.T
    zero = np.zeros(len(vectors))
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).reshape(-1, 3, 3)
