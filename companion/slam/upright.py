"""Absolute pose where the vertical is known: two points are enough (Kukelova et al., ACCV 2010).

The only file that knows poselib, whose vertical is its y axis; the loop around its solver is ours,
since its own takes no vertical.
"""

from __future__ import annotations

import numpy as np
import poselib

from companion.geometry import Array, Pose
from companion.slam.features import Bools

N_SAMPLES = 150
Y_FROM_DOWN = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""Takes a level frame with z down to one with y down."""


def upright_pose(
    points_map: Array, normalised: Array, level_from_camera: Array, max_error: float, seed: int
) -> tuple[Pose, Bools] | None:
    """`camera_from_map` that most of N points (N, 3) agree with, and which these are.

    The map's z is down; `level_from_camera` (3, 3) turns rays to a frame whose z is down too, its
    heading does not matter. `max_error` is in normalised coordinates, and has to allow for what the
    tilt is wrong by. None where no two points give a pose.
    """
    n = len(points_map)
    if n < 2:
        return None
    rays = np.c_[normalised, np.ones(n)]
    camera_from_y = (Y_FROM_DOWN @ level_from_camera).T
    rays_y = rays @ camera_from_y
    rays_y /= np.linalg.norm(rays_y, axis=1, keepdims=True)
    points_y = points_map @ Y_FROM_DOWN.T
    rng = np.random.default_rng(seed)
    rotations, translations = [], []
    for _ in range(N_SAMPLES):
        pair = rng.choice(n, 2, replace=False)
        for found in poselib.up2p(rays_y[pair], points_y[pair]):
            rotations.append(np.asarray(found.R, np.float64))
            translations.append(np.asarray(found.t, np.float64))
    if not rotations:
        return None
    turns = np.matmul(np.matmul(camera_from_y, np.stack(rotations)), Y_FROM_DOWN)
    shifts = np.stack(translations) @ camera_from_y.T
    seen = np.matmul(points_map, turns.transpose(0, 2, 1)) + shifts[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.linalg.norm(seen[..., :2] / seen[..., 2:] - normalised, axis=2)
    agree = (error < max_error) & (seen[..., 2] > 0)
    best = int(agree.sum(1).argmax())
    return Pose(turns[best], shifts[best]), agree[best]
