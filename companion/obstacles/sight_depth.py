"""Depth of followed corners, by poses that the same corners have made exact.

Poses of single frames are off by a centimetre or three across the line of sight. Over the short way
by which a thing ahead is seen from the side that is as much as its depth. Hundreds of corners tell
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
SIGMAS, WAY_SIGMAS = 2.0, 6.0
"""Of what a depth does not exceed. The longest way of many is often too long: one that hovers has
gone a decimetre and more by its poses, and what shows no parallax over that would be far away."""
MAX_RMS_PX = 1.0
MIN_IMAGES = 2
MIN_FOR_POSES = 4
"""Images before the newest: by which a depth is known; by which poses are made exact, and
a corner is known to stray."""
MOST_FOR_POSES = 350
LEAST_FOR_POSES = 60
ROUNDS = 2


@dataclass(frozen=True, slots=True, eq=False)
class SightDepth:
    """Depths of corners that were seen along one line in enough images.

    Rays (N, 3), with z 1 in the newest camera, inverse depths (N,), 1/m, standard deviations (N,)
    of these, and what they do not exceed (N,), even if the way was shorter than the poses say.
    `stray` marks, of all that were followed, what was surely not seen along one line: it slides
    along an edge, or moves by itself.
    """

    rays: Array
    inverse_m: Array
    sigma: Array
    most_inverse_m: Array
    stray: NDArray[np.bool_]


@dataclass(slots=True, eq=False)
class _Earlier:
    """Relative poses of K earlier cameras: rotations (K, 3, 3) and places (K, 3) of the newest."""

    rotations: Array
    places: Array


@dataclass(slots=True, eq=False)
class _Estimate:
    rho: Array
    rms: Array
    """Distance from where the depth says it was, ideal normalised coordinates."""
    n_images: NDArray[np.int64]
    lever: Array
    """Most by which a corner moves for a change of rho by one."""
    way: Array
    """Between the cameras of that."""


def sight_depth(seen: Array, world_from_camera: list[Pose], focal_px: float) -> SightDepth:
    """Depths of corners (K, N, 2), seen from K poses, metres; the newest last."""
    now = world_from_camera[-1]
    relative = [pose.inverse() @ now for pose in world_from_camera[:-1]]
    earlier = _Earlier(
        np.stack([pose.rotation for pose in relative]),
        np.stack([pose.translation for pose in relative]),
    )
    rays = np.c_[seen[-1], np.ones(seen.shape[1])]
    before = seen[:-1]
    refined = _refined(rays, before, earlier, focal_px)
    noise_rad = CORNER_PX / focal_px if refined else float(np.hypot(CORNER_PX / focal_px, POSE_RAD))
    found = _estimate(rays, before, earlier)
    rho, way = found.rho, found.way
    sigma = np.hypot(noise_rad / found.lever, rho * LEFT_RATIO * way / found.lever)
    sure_way = np.maximum(1.0 - WAY_SIGMAS * POSE_M / np.maximum(way, 1e-9), 1e-9)
    most = (np.maximum(rho, 0.0) + SIGMAS * sigma) / sure_way
    is_on_line = found.rms * focal_px <= MAX_RMS_PX
    good = (found.n_images >= MIN_IMAGES) & is_on_line
    stray = refined & ~is_on_line & (found.n_images >= MIN_FOR_POSES)
    return SightDepth(rays[good], rho[good], sigma[good], most[good], stray)


def _estimate(rays: Array, before: Array, earlier: _Earlier) -> _Estimate:
    """Inverse depth along rays (N, 3), by least squares along the epipolar lines of (K, N, 2)."""
    x, y, z = (rays @ earlier.rotations.transpose(0, 2, 1)).transpose(2, 0, 1)
    tx, ty, tz = earlier.places.T[..., None]
    u, v = before[..., 0], before[..., 1]
    known = ~np.isnan(u)
    # by how much each has moved, and by how much it does for inverse depth 1
    dx, dy = np.where(known, u - x / z, 0.0), np.where(known, v - y / z, 0.0)
    sx, sy = np.where(known, (tx - u * tz) / z, 0.0), np.where(known, (ty - v * tz) / z, 0.0)
    along = sx * sx + sy * sy
    all_along = np.maximum(along.sum(0), 1e-12)
    rho = (dx * sx + dy * sy).sum(0) / all_along
    n_images = known.sum(0)
    rest = (dx * dx + dy * dy).sum(0) - rho**2 * all_along
    rms = np.sqrt(np.maximum(rest, 0.0) / np.maximum(n_images, 1))
    longest = along.argmax(0)
    lever = np.sqrt(np.maximum(along.max(0), 1e-18))
    way = np.linalg.norm(earlier.places, axis=1)[longest]
    return _Estimate(rho, rms, n_images, lever, way)


def _refined(rays: Array, before: Array, earlier: _Earlier, focal_px: float) -> bool:
    """Fit relative poses to the corners, by turns with their depths; the ways keep their lengths.

    Corners that do not fit weigh little (Cauchy). False where there are too few.
    """
    found = np.flatnonzero((~np.isnan(before[..., 0])).sum(0) >= MIN_FOR_POSES)
    if len(found) < LEAST_FOR_POSES:
        return False
    few = found[:: -(-len(found) // MOST_FOR_POSES)]
    rays, before = rays[few], before[:, few]
    for _ in range(ROUNDS):
        rho = np.maximum(_estimate(rays, before, earlier).rho, 0.0)
        _step(before, rays, rho, earlier, focal_px)
    return True


def _step(before: Array, rays: Array, rho: Array, earlier: _Earlier, focal_px: float) -> None:
    """One step of Gauss and Newton of poses that see points at `rho` of rays as `before`."""
    known = ~np.isnan(before[..., 0])
    ways = np.linalg.norm(earlier.places, axis=1)
    turned = rays @ earlier.rotations.transpose(0, 2, 1)
    at = turned + rho[:, None] * earlier.places[:, None]
    z = np.where(at[..., 2] > 1e-3, at[..., 2], np.inf)
    x, y = at[..., 0] / z, at[..., 1] / z
    error = focal_px * (before - np.stack([x, y], 2))
    error[~known] = 0.0
    weight = known / (1.0 + (error**2).sum(2) / (4.0 * FOLLOWED_PX**2))
    # image motion by translation, then by rotation: (u, v) of each of six columns
    iz, zero = focal_px / z, np.zeros(z.shape)
    a, b, c = np.moveaxis(turned, 2, 0)
    # of u, and of v: d/dx, d/dy and d/dz of the projection, by place times rho, by turn
    u = np.stack([iz * rho, zero, -x * iz * rho, -x * iz * b, iz * c + x * iz * a, -iz * b], 2)
    v = np.stack([zero, iz * rho, -y * iz * rho, -iz * c - y * iz * b, y * iz * a, iz * a], 2)
    jacobian = np.concatenate([u, v], 1)
    weighted = jacobian * np.concatenate([weight, weight], 1)[..., None]
    residual = np.concatenate([error[..., 0], error[..., 1]], 1)
    place_weight = (FOLLOWED_PX / (POSE_M + POSE_RATIO * ways)) ** 2
    prior = np.zeros((len(ways), 6, 6))
    prior[:, [0, 1, 2], [0, 1, 2]] = place_weight[:, None]
    prior[:, [3, 4, 5], [3, 4, 5]] = (FOLLOWED_PX / POSE_RAD) ** 2
    normal = weighted.transpose(0, 2, 1) @ jacobian + prior
    gradient = (weighted.transpose(0, 2, 1) @ residual[..., None])[..., 0]
    steps = np.linalg.solve(normal, gradient[..., None])[..., 0]
    for k in np.flatnonzero((known.sum(1) >= LEAST_FOR_POSES) & (ways >= 1e-6)):
        direction = earlier.places[k] / ways[k]
        earlier.places[k] += steps[k, :3] - direction * (direction @ steps[k, :3])
        earlier.rotations[k] = rotation_from_vector(steps[k, 3:]) @ earlier.rotations[k]
