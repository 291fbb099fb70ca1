"""Absolute pose with known gravity: the two-point solver (Kukelova et al., ACCV 2010)."""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Array, Pose
from companion.slam.features.orb_features import Bools

N_SAMPLES = 150
EPSILON = 1e-9
"""Smallest divisor, in units of the length of a ray."""


def upright_pose(
    points_map: Array, normalised: Array, level_from_camera: Array, max_error: float, seed: int
) -> tuple[Pose, Bools] | None:
    """`camera_from_map` of most inliers among N points (N, 3), and the inlier mask.

    The z axis of the map is down; `level_from_camera` (3, 3) rotates rays to a frame with z down
    and any heading. `max_error` is in normalised coordinates, and has to allow for the tilt error.
    None where no pair gives a pose.
    """
    n = len(points_map)
    if n < 2:
        return None
    rays = np.c_[normalised, np.ones(n)] @ level_from_camera.T
    rng = np.random.default_rng(seed)
    pairs = np.array([rng.choice(n, 2, replace=False) for _ in range(N_SAMPLES)])
    rotations, translations = _from_pairs(rays[pairs], points_map[pairs])
    if not len(rotations):
        return None
    camera_from_level = level_from_camera.T
    rotations = np.matmul(camera_from_level, rotations)
    shifts = translations @ camera_from_level.T
    seen = np.matmul(points_map, rotations.transpose(0, 2, 1)) + shifts[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.linalg.norm(seen[..., :2] / seen[..., 2:] - normalised, axis=2)
    agree = (error < max_error) & (seen[..., 2] > 0)
    best = int(agree.sum(1).argmax())
    return Pose(rotations[best], shifts[best]), agree[best]


def rotations_about_z(cosine: Array, sine: Array) -> Array:
    """Rotations (N, 3, 3) about the z axis by angles of these cosines and sines (N,)."""
    rotations = np.zeros((len(cosine), 3, 3))
    rotations[:, 0, 0] = rotations[:, 1, 1] = cosine
    rotations[:, 0, 1], rotations[:, 1, 0] = -sine, sine
    rotations[:, 2, 2] = 1.0
    return rotations


def _from_pairs(rays: Array, points: Array) -> tuple[Array, Array]:
    """Rotations (M, 3, 3) about z and translations (M, 3) that put pairs of points on their rays.

    Both (N, 2, 3). With depths d and the difference D of the points, d1 r1 - d2 r2 is D rotated:
    its z is that of D, which leaves a line of depths, and its horizontal length is that of D, a
    quadratic along that line. Up to two solutions per pair.
    """
    across, along_z = rays[..., :2] * [[1.0], [-1.0]], rays[..., 2] * [1.0, -1.0]
    difference = points[:, 0] - points[:, 1]
    steep = (along_z**2).sum(1)
    first, second = rays[:, 0], rays[:, 1]
    enough = steep > EPSILON * ((first**2).sum(1) + (second**2).sum(1))
    steep = np.where(enough, steep, 1.0)
    nearest = along_z * (difference[:, 2] / steep)[:, None]
    line = np.stack([-along_z[:, 1], along_z[:, 0]], 1)
    at = (nearest[..., None] * across).sum(1)
    step = (line[..., None] * across).sum(1)
    a, b = (step**2).sum(1), (at * step).sum(1)
    c = (at**2).sum(1) - (difference[:, :2] ** 2).sum(1)
    square = b**2 - a * c
    enough &= (square >= 0) & (a > EPSILON * steep)
    root, a = np.sqrt(np.where(enough, square, 0.0)), np.where(enough, a, 1.0)
    along = np.stack([(-b - root) / a, (-b + root) / a], 1)
    depths = nearest[:, None] + along[..., None] * line[:, None]
    rotated = at[:, None] + along[..., None] * step[:, None]
    good = enough[:, None] & (depths > 0).all(2)
    before = np.arctan2(difference[:, 1], difference[:, 0])
    heading = (np.arctan2(rotated[..., 1], rotated[..., 0]) - before[:, None])[good]
    rotations = rotations_about_z(np.cos(heading), np.sin(heading))
    which = np.nonzero(good)[0]
    on_ray = depths[good][:, :1] * first[which]
    return rotations, on_ray - np.einsum("nij,nj->ni", rotations, points[which, 0])
