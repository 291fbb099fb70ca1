"""Pose of a planar board in one view, for a known lens."""

from __future__ import annotations

import math

import cv2
import numpy as np

from companion.calibration.board_image import (
    LensModel,
    camera_of,
    project_corners,
    reprojection_residual,
)
from companion.calibration.board_views import View
from companion.geometry.transforms import Array

MAX_AMBIGUITY_RATIO = 25.0
"""Cost ratio above which the second planar pose solution is not refined."""


def board_pose(view: View, model: LensModel, parameters: Array) -> Array | None:
    """Board pose for a known lens: the better of the two planar solutions (IPPE)."""
    camera = camera_of(model, parameters, view.width, view.height)
    normalised = camera.normalise(view.detection.image_px)
    usable = np.isfinite(normalised).all(1)
    if usable.sum() < 6:
        return None
    # normalised coordinates diverge far off axis: use a frame that faces the board
    rays = np.concatenate([normalised[usable], np.ones((int(usable.sum()), 1))], 1)
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    facing = _look_at(rays.mean(0))
    faced = rays @ facing.T
    try:
        n, turns, shifts, _ = cv2.solvePnPGeneric(
            view.detection.board_m[usable], faced[:, :2] / faced[:, 2:], np.eye(3), None,
            flags=cv2.SOLVEPNP_IPPE,
        )  # fmt: skip
    except cv2.error:  # collinear corners, possibly by the lens guess
        return None
    found = []
    for turn, shift in list(zip(turns, shifts, strict=True))[:n]:
        back = cv2.Rodrigues(facing.T @ cv2.Rodrigues(turn)[0])[0]
        pose = np.concatenate([np.ravel(back), facing.T @ np.ravel(shift)])
        if np.isfinite(pose).all() and pose[5] > 0:
            found.append((_pose_cost(view, model, parameters, pose), pose))
    found.sort(key=lambda one: one[0])
    best: tuple[float, Array] | None = None
    for before, pose in found:
        if best is not None and before > MAX_AMBIGUITY_RATIO * found[0][0]:
            break
        refined = refined_pose(view, model, parameters, pose)
        cost = _pose_cost(view, model, parameters, refined)
        if math.isfinite(cost) and (best is None or cost < best[0]):
            best = cost, refined
    return None if best is None else best[1]


def _look_at(direction: Array) -> Array:
    """Rotation of a direction onto the optical axis."""
    forward = direction / np.linalg.norm(direction)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    out: Array = np.stack([right, np.cross(forward, right), forward])
    return out


def _pose_cost(view: View, model: LensModel, parameters: Array, pose: Array) -> float:
    return float((reprojection_residual(view, model, parameters, pose) ** 2).sum())


def refined_pose(view: View, model: LensModel, parameters: Array, pose: Array) -> Array:
    """Board pose of least squares near another (6,), for a known lens."""
    damping = 1e-3
    for _ in range(20):
        pixels, _, by = project_corners(view, model, parameters, pose)
        residual = (view.detection.image_px - pixels).reshape(-1)
        cost = float(residual @ residual)
        normal = by.T @ by
        damped = normal + damping * np.diag(np.diag(normal))
        tried = pose + np.linalg.solve(damped, by.T @ residual)
        tried_cost = _pose_cost(view, model, parameters, tried)
        if tried_cost < cost:
            pose, damping = tried, max(damping / 10, 1e-9)
            if tried_cost > (1 - 1e-6) * cost:
                break
        else:
            damping *= 10
    return pose
