"""Where a lens images a board's corners, and what each parameter and the pose do to that.

Parameters are fx fy cx cy k…, then a b c of the board's depth a x^2 + b x y + c y^2 in metres; a
pose is camera_from_board as rotation vector and translation, (6,).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.calibration.board_views import View
from companion.geometry.camera import Camera, Distortion
from companion.geometry.transforms import Array

N_BOW = 3
"""Of the board's depth a x^2 + b x y + c y^2."""
N_COEFFICIENTS = {Distortion.RADTAN: 5, Distortion.EQUIDISTANT: 4}


@dataclass(frozen=True, slots=True)
class LensModel:
    """A distortion model, of whose coefficients the last ones may be kept at zero."""

    distortion: Distortion
    n_free: int
    bowed: bool = True
    """Whether the board may be."""

    @property
    def n_lens(self) -> int:
        """How many parameters fx fy cx cy k… there are; those of the board follow."""
        return 4 + N_COEFFICIENTS[self.distortion]

    @property
    def free(self) -> NDArray[np.int64]:
        """Which of the parameters are solved for."""
        bow = self.n_lens + np.arange(N_BOW if self.bowed else 0)
        return np.concatenate([np.arange(4 + self.n_free), bow])


def unexplained(view: View, model: LensModel, parameters: Array, pose: Array) -> Array:
    """Seen less computed, (N, 2)."""
    pixels, _, _ = imaged(view, model, parameters, pose)
    out: Array = view.sighting.image_px - pixels
    return out


def imaged(
    view: View, model: LensModel, parameters: Array, pose: Array
) -> tuple[Array, Array, Array]:
    """Corners (N, 2) of a view; derivatives (2 N, …) by the lens alone and by the pose."""
    fx, fy, cx, cy = parameters[:4]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    board_m = view.sighting.board_m.copy()
    board_m[:, 2] = _bows(board_m) @ parameters[-N_BOW:]
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


def projected(
    view: View, model: LensModel, parameters: Array, pose: Array
) -> tuple[Array, Array, Array]:
    """Corners (N, 2) of a view; derivatives (2 N, …) by all parameters and by the pose."""
    pixels, by_lens, by_pose = imaged(view, model, parameters, pose)
    # a corner that moves along the board's normal is one that the board's shift moves along it
    by_depth = by_pose[:, 3:] @ cv2.Rodrigues(pose[:3])[0][:, 2]
    by_bow = by_depth[:, None] * np.repeat(_bows(view.sighting.board_m), 2, axis=0)
    return pixels, np.concatenate([by_lens, by_bow], 1), by_pose


def _bows(board_m: Array) -> Array:
    x, y = board_m[:, 0], board_m[:, 1]
    out = np.empty((len(board_m), N_BOW))
    out[:, 0], out[:, 1], out[:, 2] = x * x, x * y, y * y
    return out


def camera_of(model: LensModel, parameters: Array, width: int, height: int) -> Camera:
    """The lens as the rest of the program has it."""
    fx, fy, cx, cy, *coefficients = (float(value) for value in parameters[: model.n_lens])
    return Camera(width, height, fx, fy, cx, cy, model.distortion, tuple(coefficients))
