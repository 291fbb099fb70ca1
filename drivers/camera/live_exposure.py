"""Exposure of an open camera, chosen picture by picture."""

from __future__ import annotations

import math
from typing import Protocol, runtime_checkable

from companion.config import CameraConfig
from companion.messages import Bytes
from companion.telemetry import Telemetry
from drivers.camera.camera_source import CameraSource
from drivers.camera.exposure_choice import Exposure, ExposureChoice, ExposureRange
from drivers.camera.image_speed import ImageSpeed


@runtime_checkable
class SettableCamera(Protocol):
    """A source whose exposure can be set while it runs."""

    @property
    def exposure_range(self) -> tuple[ExposureRange, Exposure] | None:
        """Limits of what can be set, and the setting; None where it chooses for itself."""

    def set_exposure(self, wanted: Exposure) -> Exposure | None:
        """Set it; what the camera took, None where it refuses and then chooses for itself."""


class LiveExposure:
    """Sets the exposure of a source, where `camera.exposure` asks for it and the source can."""

    def __init__(self, source: CameraSource, config: CameraConfig) -> None:
        asked = config.exposure == "tracking"
        self._source = source if asked and isinstance(source, SettableCamera) else None
        self.remark = ""
        """Said once: a source of this kind cannot do as asked."""
        if asked and self._source is None:
            self.remark = (
                f'camera.exposure = "tracking" works with v4l2 alone: {source.name} is left to its '
                "own exposure"
            )
        self._rate_hz = config.rate_hz
        self._choice: ExposureChoice | None = None
        self._speed = ImageSpeed()
        hfov_rad = math.radians(config.assumed_hfov_deg or 75.0)
        self.focal_px = 0.5 * config.width / math.tan(0.5 * hfov_rad)
        """Of the lens; until the calibration is known, that of the assumed field of view."""

    @property
    def now(self) -> Exposure | None:
        """The setting in force; None where the camera chooses for itself."""
        return None if self._choice is None else self._choice.now

    def take_telemetry(self, sample: Telemetry) -> None:
        """Add a sample of the vehicle's motion; from any one thread."""
        self._speed.take(sample)

    def begin(self) -> None:
        """Begin anew with a camera that has just been opened."""
        self._choice = None
        known = None if self._source is None else self._source.exposure_range
        if known is not None:
            self._choice = ExposureChoice(*known, self._rate_hz)

    def take(self, t_ns: int, grey: Bytes) -> None:
        """Add a picture (H, W), and set what follows of it."""
        if self._choice is None or self._source is None:
            return
        wanted = self._choice.step(t_ns, grey, self.focal_px * self._speed.at(t_ns))
        if wanted is None:
            return
        taken = self._source.set_exposure(wanted)
        if taken is None:
            self._choice = None
        else:
            self._choice.now = taken
