"""Exposure, gain and focus of a Video4Linux camera, as configured."""

from __future__ import annotations

from typing import Any

from linuxpy.video import device as v4l2

from companion.config import CameraConfig
from companion.errors import ConfigError

ID = v4l2.ControlID
EXPOSURE_UNIT_US = 100
EXPOSURE_MANUAL = 1


def apply_controls(path: str, fd: int, config: CameraConfig) -> tuple[int, list[str]]:
    """The exposure time in ns, 0 where the camera chooses it, and what it does not do as asked.

    What the configuration leaves to the camera is not touched. ConfigError where the camera has no
    such control or does not take that value.
    """
    controls = {int(control.id): control for control in _usable(fd)}
    remarks: list[str] = []

    def put(what: str, names: tuple[int, ...], value: int) -> int:
        known = next((controls[name] for name in names if name in controls), None)
        if known is None:
            raise ConfigError(
                f"{path}: it has no such control: leave {what} at its default, or take another "
                "camera"
            )
        if not known.minimum <= value <= known.maximum:
            raise ConfigError(
                f"{path}: {what} in its steps is {known.minimum} to {known.maximum}, given is "
                f"{value}"
            )
        v4l2.set_control(fd, known.id, value)
        given = int(v4l2.get_control(fd, known.id))
        if given != value:
            remarks.append(f"{path}: {what} is {given} in its steps, {value} was asked")
        return given

    if ID.EXPOSURE_AUTO_PRIORITY in controls:
        # else a camera in the dark takes longer exposures and gives fewer pictures than asked
        v4l2.set_control(fd, ID.EXPOSURE_AUTO_PRIORITY, 0)
    exposure_ns = 0
    if config.exposure_us > 0:
        if ID.EXPOSURE_AUTO in controls:
            v4l2.set_control(fd, ID.EXPOSURE_AUTO, EXPOSURE_MANUAL)
        steps = max(1, round(config.exposure_us / EXPOSURE_UNIT_US))
        given = put("camera.exposure_us / 100", (ID.EXPOSURE_ABSOLUTE,), steps)
        exposure_ns = given * EXPOSURE_UNIT_US * 1_000
    if config.gain >= 0:
        if ID.AUTOGAIN in controls:
            v4l2.set_control(fd, ID.AUTOGAIN, 0)
        put("camera.gain", (ID.GAIN, ID.ANALOGUE_GAIN), config.gain)
    if config.focus >= 0:
        if ID.FOCUS_AUTO in controls:
            v4l2.set_control(fd, ID.FOCUS_AUTO, 0)
        put("camera.focus", (ID.FOCUS_ABSOLUTE,), config.focus)
    return exposure_ns, remarks


def _usable(fd: int) -> list[Any]:
    unusable = v4l2.ControlFlag.DISABLED | v4l2.ControlFlag.READ_ONLY
    return [control for control in v4l2.iter_read_controls(fd) if not control.flags & unusable]
