"""Exposure, gain and focus of a Video4Linux camera, as configured or chosen in flight."""

from __future__ import annotations

from companion.config import CameraConfig
from companion.errors import ConfigError, SourceError
from drivers.camera import v4l2_ioctl as v4l2
from drivers.camera.exposure_choice import Exposure, ExposureRange
from drivers.camera.v4l2_node import CaptureNode

EXPOSURE_UNIT_US = 100
MANUAL = {v4l2.CID_EXPOSURE_AUTO: v4l2.EXPOSURE_MANUAL, v4l2.CID_AUTOGAIN: 0}
"""Controls of the automatics, and their values that put them off."""
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
    if config.exposure == "tracking" and (config.exposure_us > 0 or config.gain >= 0):
        raise ConfigError(
            'camera.exposure = "tracking" chooses exposure and gain: leave '
            "expert.camera.exposure_us and expert.camera.gain at their defaults"
        )
    if config.exposure_us > 0:
        if v4l2.CID_EXPOSURE_AUTO in controls:
            node.set_control(v4l2.CID_EXPOSURE_AUTO, v4l2.EXPOSURE_MANUAL)
        steps = max(1, round(config.exposure_us / EXPOSURE_UNIT_US))
        given = put("expert.camera.exposure_us / 100", (v4l2.CID_EXPOSURE_ABSOLUTE,), steps)
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


class ManualExposure:
    """Exposure and gain of an open camera, taken over from its automatics."""

    def __init__(self, node: CaptureNode) -> None:
        """Take over; SourceError where the camera does not let it be set, and keeps its own."""
        self._node = node
        usable = {each.id: each for each in node.controls() if not each.flags & UNUSABLE}
        exposure = usable.get(v4l2.CID_EXPOSURE_ABSOLUTE)
        if exposure is None:
            raise SourceError("it has no exposure time to set")
        gains = (v4l2.CID_GAIN, v4l2.CID_ANALOGUE_GAIN)
        self._gain = next((number for number in gains if number in usable), None)
        # not what they are now: that may be of a run that did not come to its end
        self._automatic = {n: usable[n].default_value for n in MANUAL if n in usable}
        shortest, longest = max(1, exposure.minimum), max(1, exposure.maximum)
        gain = usable[self._gain] if self._gain is not None else None
        self.range = ExposureRange(
            (shortest * EXPOSURE_UNIT_US, longest * EXPOSURE_UNIT_US),
            None if gain is None else (gain.minimum, gain.maximum),
        )
        try:
            for number in self._automatic:
                node.set_control(number, MANUAL[number])
            self.now = self._read()
            self.put(self.now)
        except OSError as error:
            self.give_back()
            raise SourceError(f"its exposure cannot be set ({error.strerror})") from error

    def put(self, wanted: Exposure) -> Exposure:
        """Set both; what the camera took, OSError where it refuses."""
        steps = max(1, wanted.exposure_us // EXPOSURE_UNIT_US)
        self._node.set_control(v4l2.CID_EXPOSURE_ABSOLUTE, steps)
        if self._gain is not None and wanted.gain is not None:
            self._node.set_control(self._gain, wanted.gain)
        self.now = self._read()
        return self.now

    def give_back(self) -> None:
        """Leave the exposure to the camera's automatics again, as far as it lets us."""
        for number, automatic in self._automatic.items():
            try:
                self._node.set_control(number, automatic)
            except OSError:
                pass  # it has refused, or has gone: there is nothing else to try

    def _read(self) -> Exposure:
        steps = self._node.control(v4l2.CID_EXPOSURE_ABSOLUTE)
        gain = None if self._gain is None else self._node.control(self._gain)
        return Exposure(max(1, steps) * EXPOSURE_UNIT_US, gain)
