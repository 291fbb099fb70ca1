"""Depth of followed corners, by poses that the same corners have made exact.

Poses of single frames are off by a centimetre or three across the line of sight. Over the short way
by which a thing ahead is seen from the side that is as much as its depth. Two thousand corners tell
the relative poses to some millimetres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.geometry.transforms import Array, Pose, rotation_from_vector

CORNER_PX = 0.5
"""Of a corner that was followed for long: its drift. The spread about its line is a half."""
FOLLOWED_PX = 0.3
POSE_M, POSE_RATIO, POSE_RAD = 0.03, 0.02, np.radians(0.1)
"""Standard deviations of given relative poses: place, of the way between them, and attitude."""
LEFT_RATIO = 0.005
"""Of the way between two poses: what is left of the error of its direction."""
MAX_RMS_PX = 1.0
MIN_IMAGES = 4
MAX_RELATIVE_SIGMA = 0.08
MOST_FOR_POSES = 700
LEAST_FOR_POSES = 60
ROUNDS = 2


@dataclass(slots=True, eq=False)
class _Estimate:
    rho: Array
    sigma: Array
    """Relative."""
    rms: Array
    """Distance from where the depth says it was, ideal normalised coordinates."""
    n_images: NDArray[np.int64]


def sight_depth(seen: Array, world_from_camera: list[Pose], focal_px: float) -> Array:
    """Points (M, 3), in the newest camera, of those corners (K, N, 2) whose depth is known.

    They were seen from K poses, metres; the newest last.
    """
    now = world_from_camera[-1]
    relative = [pose.inverse() @ now for pose in world_from_camera[:-1]]
    relative = _refined(seen, relative, focal_px)
    found = _estimate(seen, relative, focal_px)
    good = (found.n_images >= MIN_IMAGES) & (found.rho > 0)
    good &= (found.sigma <= MAX_RELATIVE_SIGMA) & (found.rms * focal_px <= MAX_RMS_PX)
    rays = np.c_[seen[-1], np.ones(seen.shape[1])]
    return np.asarray(rays[good] / found.rho[good, None])


def _estimate(seen: Array, relative: list[Pose], focal_px: float) -> _Estimate:
    """Inverse depth in the newest camera, by least squares along the epipolar lines."""
    rays = np.c_[seen[-1], np.ones(seen.shape[1])]
    n = len(rays)
    across, along, longest, way = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    parts = []
    for before, pose in zip(seen, relative, strict=False):
        turned = rays @ pose.rotation.T
        t = pose.translation
        moved = before - turned[:, :2] / turned[:, 2:]
        # a point at inverse depth rho moves by rho times this
        slope = (t[:2] - before * t[2]) / turned[:, 2:]
        known = ~np.isnan(moved[:, 0])
        moved, slope = np.where(known[:, None], moved, 0.0), np.where(known[:, None], slope, 0.0)
        length = np.hypot(slope[:, 0], slope[:, 1])
        across += (moved * slope).sum(1)
        along += length**2
        way = np.where(length > longest, float(np.linalg.norm(t)), way)
        longest = np.maximum(longest, length)
        parts.append((moved, slope, known))
    rho = across / np.maximum(along, 1e-12)
    n_images = np.sum([known for _, _, known in parts], axis=0, dtype=np.int64) + np.zeros(n, int)
    squares = [((moved - rho[:, None] * slope) ** 2).sum(1) for moved, slope, _ in parts]
    rms = np.sqrt(np.sum(squares, axis=0) / np.maximum(n_images, 1))
    lever = np.maximum(longest, 1e-9)
    noise = CORNER_PX / focal_px / (lever * np.maximum(np.abs(rho), 1e-9))
    return _Estimate(rho, np.hypot(noise, LEFT_RATIO * way / lever), rms, n_images)


def _refined(seen: Array, relative: list[Pose], focal_px: float) -> list[Pose]:
    """Relative poses that fit the corners, by turns with their depths; the ways keep their lengths.

    Corners that do not fit weigh little (Cauchy).
    """
    found = np.flatnonzero((~np.isnan(seen[:-1, :, 0])).sum(0) >= MIN_IMAGES)
    if len(found) < LEAST_FOR_POSES:
        return relative
    seen = seen[:, found[:: -(-len(found) // MOST_FOR_POSES)]]
    rays = np.c_[seen[-1], np.ones(seen.shape[1])]
    for _ in range(ROUNDS):
        rho = np.maximum(_estimate(seen, relative, focal_px).rho, 0.0)
        relative = [
            _step(before, rays, rho, pose, focal_px)
            for before, pose in zip(seen, relative, strict=False)
        ]
    return relative


def _step(before: Array, rays: Array, rho: Array, pose: Pose, focal_px: float) -> Pose:
    """One step of Gauss and Newton of a pose that sees points at `rho` of rays as `before`."""
    known = ~np.isnan(before[:, 0])
    way = float(np.linalg.norm(pose.translation))
    if known.sum() < LEAST_FOR_POSES or way < 1e-6:
        return pose
    rho = rho[known]
    turned = rays[known] @ pose.rotation.T
    at = turned + rho[:, None] * pose.translation
    z = np.where(at[:, 2] > 1e-3, at[:, 2], np.inf)
    x, y = at[:, 0] / z, at[:, 1] / z
    error = focal_px * (before[known] - np.stack([x, y], 1))
    weight = 1.0 / (1.0 + (error**2).sum(1) / (4.0 * FOLLOWED_PX**2))
    # image motion by translation, then by rotation: (u, v) of each of six columns
    iz, zero = focal_px / z, np.zeros(len(z))
    by_place = np.stack([np.stack([iz, zero, -x * iz], 1), np.stack([zero, iz, -y * iz], 1)], 1)
    a, b, c = turned.T
    turns = np.stack([np.stack(row, 1) for row in ((zero, -c, b), (c, zero, -a), (-b, a, zero))], 1)
    by_turn = np.einsum("nic,njc->nij", by_place, turns)
    jacobian = np.concatenate([rho[:, None, None] * by_place, by_turn], 2)
    weighted = jacobian * weight[:, None, None]
    place_weight = (FOLLOWED_PX / (POSE_M + POSE_RATIO * way)) ** 2
    prior = np.diag([place_weight] * 3 + [(FOLLOWED_PX / POSE_RAD) ** 2] * 3)
    normal = np.einsum("nij,nik->jk", weighted, jacobian) + prior
    step = np.linalg.solve(normal, np.einsum("nij,ni->j", weighted, error))
    direction = pose.translation / way
    place = step[:3] - direction * (direction @ step[:3])
    return Pose(rotation_from_vector(step[3:]) @ pose.rotation, pose.translation + place)
