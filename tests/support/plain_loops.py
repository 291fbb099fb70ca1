"""What the compiled loops do, in plain numpy: what they are compared with."""

from __future__ import annotations

import numpy as np

from companion.geometry import Array, Pose, nearest_rotation, rotation_from_vector
from companion.slam.compiled.pose import CHI2_2D, HUBER
from companion.slam.features import Bools


def _residuals(
    camera_from_map: Pose, points_map: Array, normalised: Array, whitening: Array
) -> tuple[Array, Array]:
    """Whitened reprojection errors (N, 2) and depths (N,)."""
    p = camera_from_map.apply(points_map)
    z = np.where(np.abs(p[:, 2]) < 1e-9, 1e-9, p[:, 2])
    error = p[:, :2] / z[:, None] - normalised
    return np.einsum("nij,nj->ni", whitening, error), p[:, 2]


def robust_cost(
    camera_from_map: Pose, points_map: Array, normalised: Array, whitening: Array
) -> float:
    """Huber's loss of all N points, those behind the camera at a high price."""
    r, depth = _residuals(camera_from_map, points_map, normalised, whitening)
    size = np.sqrt((r * r).sum(1))
    loss = np.where(size < HUBER, 0.5 * size * size, HUBER * (size - 0.5 * HUBER))
    return float(np.where(depth > 0, loss, HUBER * 100.0).sum())


def refine_pose(
    camera_from_map: Pose,
    points_map: Array,
    normalised: Array,
    whitening: Array,
    rounds: int = 4,
    iterations: int = 4,
) -> tuple[Pose, Bools, Array]:
    """Refine a pose on N points; after each round points with too large an error are set aside.

    Huber's loss in all rounds but the last. Returns the pose, which points agree with it (N,), and
    the (6, 6) information matrix (rotation, translation) in the camera frame.
    """
    pose = camera_from_map
    inlier = np.ones(len(points_map), bool)
    information = np.zeros((6, 6))
    for round_ in range(rounds):
        robust = round_ < rounds - 1
        if np.count_nonzero(inlier) < 6:
            break
        pts, obs, white = points_map[inlier], normalised[inlier], whitening[inlier]
        for _ in range(iterations):
            p = pose.apply(pts)
            z = np.where(p[:, 2] > 1e-6, p[:, 2], 1e-6)
            inv = 1.0 / z
            x, y = p[:, 0] * inv, p[:, 1] * inv
            jac = np.zeros((len(pts), 2, 6))
            # derivative of (x/z, y/z) for a left perturbation (rotation, translation)
            jac[:, 0, 0], jac[:, 0, 1], jac[:, 0, 2] = -x * y, 1 + x * x, -y
            jac[:, 1, 0], jac[:, 1, 1], jac[:, 1, 2] = -1 - y * y, x * y, x
            jac[:, 0, 3], jac[:, 0, 5] = inv, -x * inv
            jac[:, 1, 4], jac[:, 1, 5] = inv, -y * inv
            error = np.stack([x, y], 1) - obs
            r = np.matmul(white, error[..., None])[..., 0]
            jac = np.matmul(white, jac)
            size = np.sqrt((r * r).sum(1))
            weight = np.ones(len(size))
            if robust:
                weight = np.minimum(1.0, HUBER / np.maximum(size, 1e-9))
            flat = jac.reshape(-1, 6)
            w2 = np.repeat(weight, 2)
            information = (flat * w2[:, None]).T @ flat
            gradient = flat.T @ (w2 * r.ravel())
            try:
                delta = -np.linalg.solve(information + 1e-9 * np.eye(6), gradient)
            except np.linalg.LinAlgError:
                break
            turn = rotation_from_vector(delta[:3])
            pose = Pose(turn @ pose.rotation, turn @ pose.translation + delta[3:])
            if np.abs(delta).max() < 1e-6:
                break
        r, depth = _residuals(pose, points_map, normalised, whitening)
        inlier = ((r * r).sum(1) < CHI2_2D) & (depth > 0)
    # a pose is refined from one predicted from the last: what rounding adds would grow with each
    return Pose(nearest_rotation(pose.rotation), pose.translation), inlier, information
