"""Exposure, gain and focus of a Video4Linux camera, as configured."""

from __future__ import annotations

from companion.config import CameraConfig
from companion.errors import ConfigError
from drivers.camera import v4l2_ioctl as v4l2
from drivers.camera.v4l2_node import CaptureNode

EXPOSURE_UNIT_US = 100
UNUSABLE = v4l2.CTRL_FLAG_DISABLED | v4l2.CTRL_FLAG_READ_ONLY


def apply_controls(path: str, node: CaptureNode, config: CameraConfig) -> tuple[int, list[str]]:
    """Set the controls; exposure time in ns, 0 for automatic, and deviations from the request.

    Controls that are not configured are left alone. ConfigError where the camera has no such
    control or does not take that value.
    """
    controls = {each.id: each for each in node.controls() if not each.flags & UNUSABLE}
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
        node.set_control(known.id, value)
        given = node.control(known.id)
        if given != value:
            remarks.append(f"{path}: {what} is {given} in its steps, {value} was asked")
        return given

    if v4l2.CID_EXPOSURE_AUTO_PRIORITY in controls:
        # else a camera in the dark takes longer exposures and gives fewer pictures than asked
        node.set_control(v4l2.CID_EXPOSURE_AUTO_PRIORITY, 0)
    exposure_ns = 0
    if config.exposure_us > 0:
        if v4l2.CID_EXPOSURE_AUTO in controls:
            node.set_control(v4l2.CID_EXPOSURE_AUTO, v4l2.EXPOSURE_MANUAL)
        steps = max(1, round(config.exposure_us / EXPOSURE_UNIT_US))
        given = put("camera.exposure_us / 100", (v4l2.CID_EXPOSURE_ABSOLUTE,), steps)
        exposure_ns = given * EXPOSURE_UNIT_US * 1_000
    if config.gain >= 0:
        if v4l2.CID_AUTOGAIN in controls:
            node.set_control(v4l2.CID_AUTOGAIN, 0)
        put("expert.camera.gain", (v4l2.CID_GAIN, v4l2.CID_ANALOGUE_GAIN), config.gain)
    if config.focus >= 0:
        if v4l2.CID_FOCUS_AUTO in controls:
            node.set_control(v4l2.CID_FOCUS_AUTO, 0)
        put("expert.camera.focus", (v4l2.CID_FOCUS_ABSOLUTE,), config.focus)
    return exposure_ns, remarks
