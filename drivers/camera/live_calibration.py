"""Camera model of a live run: from its calibration file, or as configured."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from companion.config import CameraConfig, MountConfig
from companion.errors import ConfigError, FlightError
from companion.geometry.camera import Camera
from companion.geometry.transforms import Pose
from drivers.camera.pattern_camera import pattern_optics
from drivers.images.calibration_file import (
    assumed_camera,
    configured_rotation,
    own_calibration,
    read_calibration,
    states_gimbal,
    with_mount,
    with_readout,
)


def live_camera(
    config: CameraConfig, mount: MountConfig, width: int, height: int
) -> tuple[Camera, list[str]]:
    """Camera of a live run for images of this size, and a remark on what is only assumed.

    FlightError or ConfigError where the configuration is impossible. A flight folder played as a
    camera brings its own calibration, and so does the test pattern.
    """
    warnings = []
    file = _calibration_file(config)
    if file is not None:
        camera = read_calibration(file, width, height)
    elif config.source == "pattern":
        camera = pattern_optics(config)
    elif config.assumed_hfov_deg > 0:
        camera = assumed_camera(width, height, config.assumed_hfov_deg)
        warnings.append(
            f"no camera.calibration: the camera is taken to be {config.assumed_hfov_deg:g} degrees "
            "wide and without distortion"
        )
    else:
        raise ConfigError(
            "no camera.calibration; give one, or a field of view by camera.assumed_hfov_deg"
        )
    if mount.type == "gimbal":
        camera = with_mount(camera, mount)
    elif mount.known:
        if camera.body_from_camera is not None:
            raise ConfigError(
                f"{file or 'the test pattern'} says how the camera sits on the body, and so does "
                "[mount]; set mount.known = false, or take body_from_camera out of the file"
            )
        camera = dataclasses.replace(camera, body_from_camera=body_from_camera(mount))
    elif camera.body_from_camera is None:
        warnings.append(
            "how the camera sits on the body is not known, so that the autopilot's attitude cannot "
            "be used; set [mount]"
        )
    return with_readout(camera, config.readout_ms), warnings


def check_calibration(config: CameraConfig, mount: MountConfig) -> None:
    """Raise what `live_camera` will for pictures of any size, before there is a camera."""
    file = _calibration_file(config)
    if file is not None:
        own = own_calibration(file)
        live_camera(config, mount, own.width, own.height)


def is_on_gimbal(config: CameraConfig, mount: MountConfig) -> bool:
    """True where settings or calibration say so; what `live_camera` cannot read says nothing."""
    file = _calibration_file(config)
    if mount.type == "gimbal" or file is None:
        return mount.type == "gimbal"
    try:
        return states_gimbal(file)
    except FlightError:
        return False


def body_from_camera(mount: MountConfig) -> Pose:
    """Mounting of a camera, as configured."""
    return Pose(configured_rotation(mount), np.array([mount.x_m, mount.y_m, mount.z_m]))


def _calibration_file(config: CameraConfig) -> Path | None:
    if config.calibration:
        return Path(config.calibration)
    own = Path(config.path) / "camera.json"
    return own if config.source == "file" and config.path and own.exists() else None
