"""Projection of board corners, with Jacobians by lens, board shape and pose.

Parameters are fx fy cx cy k..., then a b c of the board depth a x^2 + b x y + c y^2 in metres; a
pose is camera_from_board as rotation vector and translation, (6,).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.calibration.board_views import View
from companion.geometry.camera import COEFFICIENTS, Camera, Distortion
from companion.geometry.transforms import Array

N_CURVATURE = 3
"""Coefficients of the board depth a x^2 + b x y + c y^2."""


@dataclass(frozen=True, slots=True)
class LensModel:
    """A distortion model; trailing coefficients may be fixed at zero."""

    distortion: Distortion
    n_free: int
    curved: bool = True
    """True if the curvature of the board is estimated."""

    @property
    def n_lens(self) -> int:
        """Number of lens parameters fx fy cx cy k...; those of the board follow."""
        return 4 + len(COEFFICIENTS[self.distortion])

    @property
    def free(self) -> NDArray[np.int64]:
        """Indices of the estimated parameters."""
        bow = self.n_lens + np.arange(N_CURVATURE if self.curved else 0)
        return np.concatenate([np.arange(4 + self.n_free), bow])


def reprojection_residual(view: View, model: LensModel, parameters: Array, pose: Array) -> Array:
    """Observed minus projected corners, (N, 2)."""
    pixels, _, _ = project_corners(view, model, parameters, pose)
    out: Array = view.detection.image_px - pixels
    return out


def project_corners(
    view: View, model: LensModel, parameters: Array, pose: Array
) -> tuple[Array, Array, Array]:
    """Corners (N, 2) of a view; Jacobians (2 N, ...) by the lens and by the pose."""
    fx, fy, cx, cy = parameters[:4]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    board_m = view.detection.board_m.copy()
    board_m[:, 2] = _curvature_terms(board_m) @ parameters[-N_CURVATURE:]
    lens = parameters[4 : model.n_lens]
    if model.distortion is Distortion.RADTAN:
        pixels, by = cv2.projectPoints(board_m, pose[:3], pose[3:], matrix, lens)
        by_pose, by_lens = by[:, :6], by[:, 6:15]
    else:
        pixels, by = cv2.fisheye.projectPoints(board_m[:, None], pose[:3], pose[3:], matrix, lens)
        by_lens, by_pose = by[:, :8], by[:, 8:14]
    return (
        np.asarray(pixels, np.float64).reshape(-1, 2),
        np.asarray(by_lens, np.float64), np.asarray(by_pose, np.float64),
    )  # fmt: skip


def project_with_jacobians(
    view: View, model: LensModel, parameters: Array, pose: Array
) -> tuple[Array, Array, Array]:
    """Corners (N, 2) of a view; Jacobians (2 N, ...) by all parameters and by the pose."""
    pixels, by_lens, by_pose = project_corners(view, model, parameters, pose)
    # corner displacement along the board normal equals board translation along it
    by_depth = by_pose[:, 3:] @ cv2.Rodrigues(pose[:3])[0][:, 2]
    by_bow = by_depth[:, None] * np.repeat(_curvature_terms(view.detection.board_m), 2, axis=0)
    return pixels, np.concatenate([by_lens, by_bow], 1), by_pose


def _curvature_terms(board_m: Array) -> Array:
    x, y = board_m[:, 0], board_m[:, 1]
    out = np.empty((len(board_m), N_CURVATURE))
    out[:, 0], out[:, 1], out[:, 2] = x * x, x * y, y * y
    return out


def camera_of(model: LensModel, parameters: Array, width: int, height: int) -> Camera:
    """Camera with these lens parameters."""
    fx, fy, cx, cy, *coefficients = (float(value) for value in parameters[: model.n_lens])
    return Camera(width, height, fx, fy, cx, cy, model.distortion, tuple(coefficients))
