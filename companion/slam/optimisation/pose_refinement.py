"""Pose of one camera from observed map points: robust Gauss-Newton, and SQPnP."""

from __future__ import annotations

import cv2
import numpy as np

from companion.geometry.transforms import Array, Pose
from companion.slam.compiled.pose_kernels import CHI2_2D, HUBER, cost, refine
from companion.slam.features.orb_features import Bools

__all__ = ["CHI2_2D", "HUBER", "refine_pose", "robust_cost", "solve_sqpnp"]


def robust_cost(
    camera_from_map: Pose, points_map: Array, normalised: Array, whitening: Array
) -> float:
    """Huber's loss of all N points, those behind the camera at a high constant."""
    pose = camera_from_map.rotation, camera_from_map.translation
    return float(cost(*pose, points_map, normalised, whitening))


def solve_sqpnp(points_map: Array, normalised: Array) -> Pose | None:
    """`camera_from_map` of N points without initial guess (Terzakis & Lourakis, ECCV 2020).

    SQPnP: in front of a plane a pose can have two minima; this finds the global one. Not robust to
    outliers.
    """
    if len(points_map) < 6:
        return None
    ok, rotvec, translation = cv2.solvePnP(
        points_map, normalised, np.eye(3), np.zeros(0), flags=cv2.SOLVEPNP_SQPNP
    )
    if not ok:
        return None
    rotation = np.asarray(cv2.Rodrigues(rotvec)[0], np.float64)
    return Pose(rotation, np.asarray(translation, np.float64).ravel())


def refine_pose(
    camera_from_map: Pose,
    points_map: Array,
    normalised: Array,
    whitening: Array,
    rounds: int = 4,
    iterations: int = 4,
) -> tuple[Pose, Bools, Array]:
    """Refine a pose on N points; outliers are reclassified after each round.

    Huber's loss in all rounds but the last. Returns the pose, the inlier mask (N,), and the (6, 6)
    information matrix (rotation, translation) in the camera frame.
    """
    rotation, translation, inlier, information = refine(
        camera_from_map.rotation, camera_from_map.translation,
        points_map, normalised, whitening, rounds, iterations,
    )  # fmt: skip
    return Pose(rotation, translation), inlier, information
