"""Camera calibration file: intrinsics, distortion, and mounting on the body."""

from __future__ import annotations

import dataclasses
import json
import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from companion.config import MountConfig
from companion.errors import ConfigError, FlightError
from companion.geometry.camera import COEFFICIENTS, Camera, Distortion
from companion.geometry.gimbal import Gimbal
from companion.geometry.transforms import (
    Array,
    Pose,
    quaternion_from_euler,
    rotation_from_quaternion,
)
from drivers.images.text_table import numbers_of, read_rows

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

MODELS = {
    "none": Distortion.NONE,
    "pinhole": Distortion.NONE,
    "radtan": Distortion.RADTAN,
    "plumb_bob": Distortion.RADTAN,
    "equidistant": Distortion.EQUIDISTANT,
    "fisheye": Distortion.EQUIDISTANT,
}
MAX_TURN_ERROR = 1e-3
MAX_READOUT_MS = 200.0
"""No camera that gives 5 frames/s or more takes longer."""
AS_CALIBRATED = -1.0
"""Value of `camera.readout_ms` that leaves it to the calibration."""
FORWARD_UPRIGHT: Array = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Rotation body_from_camera of a camera that looks forward, upright."""


def read_calibration(path: Path, width: int, height: int) -> Camera:
    """Camera of a JSON or TOML file, which must be for images of this size.

    FlightError otherwise. Coefficients are given by name or as a list `D`, where radtan's fifth may
    be left out.
    """
    content = _content(path)
    size = _size(path, content)
    if size != (width, height):
        raise FlightError(
            f"{path}: it is for pictures of {size[0]:g} x {size[1]:g}, those that come are "
            f"{width} x {height}; give the calibration for that size"
        )
    fx, fy, cx, cy = (_number(path, content, key) for key in ("fx", "fy", "cx", "cy"))
    if fx <= 0 or fy <= 0:
        raise FlightError(f"{path}: fx and fy must be positive, they are {fx:g} and {fy:g}")
    if not (0 < cx < width and 0 < cy < height):
        raise FlightError(f"{path}: cx, cy = {cx:g}, {cy:g} lie outside of the picture")
    model = _model(path, content)
    return Camera(
        width, height, fx, fy, cx, cy, model, _coefficients(path, content, model),
        body_from_camera_of(path, content.get("body_from_camera")), content.get("assumed") is True,
        _readout_ms(path, content), _gimbal(path, content),
    )  # fmt: skip


def own_calibration(path: Path) -> Camera:
    """Camera of a file, for pictures of the size that it states itself; FlightError if invalid."""
    width, height = _size(path, _content(path))
    return read_calibration(path, int(width), int(height))


def states_gimbal(path: Path) -> bool:
    """True where a calibration says that the camera is on a gimbal; FlightError if unreadable."""
    return _content(path).get("gimbal") is not None


def with_mount(camera: Camera, mount: MountConfig) -> Camera:
    """The camera on the gimbal that is configured, if any.

    Where nothing says how it sits in the gimbal's head, it looks forward there, turned by the
    configured angles.
    """
    if mount.type == "fixed":
        return camera
    gimbal = Gimbal(
        (mount.x_m, mount.y_m, mount.z_m), mount.gimbal_delay_ms, mount.gimbal_sigma_deg
    )
    inside = camera.body_from_camera
    if inside is None:
        inside = Pose(configured_rotation(mount), np.zeros(3))
    return dataclasses.replace(camera, body_from_camera=inside, gimbal=gimbal)


def configured_rotation(mount: MountConfig) -> Array:
    """Rotation (3, 3) of a camera by the configured angles."""
    turned = quaternion_from_euler(
        math.radians(mount.roll_deg), math.radians(mount.pitch_deg), math.radians(mount.yaw_deg)
    )
    return np.asarray(rotation_from_quaternion(turned) @ FORWARD_UPRIGHT)


def with_readout(camera: Camera, readout_ms: float) -> Camera:
    """The camera with the readout that is configured; -1 leaves it as it is.

    ConfigError for any other negative number.
    """
    if readout_ms == AS_CALIBRATED:
        return camera
    if readout_ms < 0:
        raise ConfigError(
            f"camera.readout_ms = {readout_ms:g}: give the readout in milliseconds, 0 for a global "
            "shutter, or -1 to take it from the calibration"
        )
    return dataclasses.replace(camera, readout_ms=readout_ms)


def read_matrix(path: Path, width: int, height: int) -> Camera:
    """Camera of an intrinsic matrix as text, three rows of three; FlightError if invalid."""
    matrix = np.array([numbers_of(path, words[:3]) for words in read_rows(path, 3)])
    if matrix.shape != (3, 3) or min(matrix[0, 0], matrix[1, 1]) <= 0:
        raise FlightError(f"{path}: wanted an intrinsic matrix, three rows of three numbers")
    fx, fy, cx, cy = (float(matrix[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    if not (0 < cx < width and 0 < cy < height):
        raise FlightError(f"{path}: cx, cy = {cx:g}, {cy:g} lie outside of the picture")
    return Camera(width, height, fx, fy, cx, cy)


def assumed_camera(width: int, height: int, hfov_deg: float) -> Camera:
    """Camera without distortion and with this horizontal field of view, marked as assumed."""
    focal = 0.5 * width / math.tan(math.radians(hfov_deg) / 2)
    centre = (width - 1) / 2, (height - 1) / 2
    return Camera(width, height, focal, focal, *centre, assumed=True)


def _content(path: Path) -> Mapping[str, Any]:
    is_toml = path.suffix.lower() == ".toml"
    try:
        text = path.read_text("utf-8")
        content = tomllib.loads(text) if is_toml else json.loads(text)
    except OSError as error:
        raise FlightError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:  # of both formats, and of text that is none
        raise FlightError(
            f"{path}: cannot be read as {'TOML' if is_toml else 'JSON'}: {error}"
        ) from error
    if not isinstance(content, dict):
        raise FlightError(f"{path}: wanted an object with keys fx, fy, cx, cy and so on")
    return content


def _size(path: Path, content: Mapping[str, Any]) -> tuple[float, float]:
    return _number(path, content, "width"), _number(path, content, "height")


def _number(path: Path, content: Mapping[str, Any], key: str) -> float:
    if key not in content:
        raise FlightError(f"{path}: the key {key} is missing")
    value = content[key]
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise FlightError(f"{path}: {key} must be a number, it is {value!r}")
    return float(value)


def _readout_ms(path: Path, content: Mapping[str, Any]) -> float | None:
    if content.get("readout_ms") is None:
        return None
    readout_ms = _number(path, content, "readout_ms")
    if not 0 <= readout_ms <= MAX_READOUT_MS:
        raise FlightError(
            f"{path}: readout_ms must be between 0 (a global shutter) and {MAX_READOUT_MS:g}, it "
            f"is {readout_ms:g}"
        )
    return readout_ms


def _gimbal(path: Path, content: Mapping[str, Any]) -> Gimbal | None:
    if content.get("gimbal") is None:
        return None
    try:
        return Gimbal.of_document(content["gimbal"])
    except ValueError as error:
        raise FlightError(f"{path}: {error}") from error


def _model(path: Path, content: Mapping[str, Any]) -> Distortion:
    if "distortion_model" not in content:
        raise FlightError(f"{path}: the key distortion_model is missing")
    model = MODELS.get(str(content["distortion_model"]).lower())
    if model is None:
        raise FlightError(
            f"{path}: unknown distortion_model {content['distortion_model']!r}; known are "
            + ", ".join(MODELS)
        )
    return model


def _coefficients(path: Path, content: Mapping[str, Any], model: Distortion) -> tuple[float, ...]:
    keys = COEFFICIENTS[model]
    given = content.get("D")
    if given is None:
        # k3 is zero in many calibrations, and then often not written
        optional = {"k3": 0.0} if model is Distortion.RADTAN else {}
        filled = {**optional, **content}
        return tuple(_number(path, filled, key) for key in keys)
    if not isinstance(given, list):
        raise FlightError(f"{path}: D must be a list of {len(keys)} numbers")
    if model is Distortion.RADTAN and len(given) == len(keys) - 1:
        given = [*given, 0.0]
    if model is Distortion.NONE and not any(given):
        return ()
    if len(given) != len(keys):
        raise FlightError(
            f"{path}: D has {len(given)} numbers, {model.value} wants {len(keys)}: "
            + (", ".join(keys) or "none")
        )
    return tuple(_number(path, {f"D[{i}]": value}, f"D[{i}]") for i, value in enumerate(given))


def body_from_camera_of(path: Path, given: Any) -> Pose | None:
    """Transform of a 4 x 4 matrix, None for None; FlightError if invalid."""
    if given is None:
        return None
    try:
        matrix = np.asarray(given, np.float64)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise FlightError(f"{path}: body_from_camera must be a 4 x 4 matrix of numbers")
    rotation = matrix[:3, :3]
    away = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if (
        away > MAX_TURN_ERROR
        or np.linalg.det(rotation) < 0
        or (np.abs(matrix[3] - [0, 0, 0, 1]).max() > MAX_TURN_ERROR)
    ):
        raise FlightError(
            f"{path}: body_from_camera is no rigid transform: its 3 x 3 part must be a rotation "
            "(orthonormal, determinant +1) and its last row 0 0 0 1"
        )
    u, _, vt = np.linalg.svd(rotation)  # files round their numbers
    return Pose(u @ vt, matrix[:3, 3].copy())
