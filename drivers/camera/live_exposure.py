"""Exposure of an open camera, chosen picture by picture."""

from __future__ import annotations

import math
from typing import Protocol, runtime_checkable

import numpy as np

from companion.config import CameraConfig
from companion.messages import Bytes
from companion.telemetry import AttitudeSample, ImuSample, PositionSample, RangeSample, Telemetry
from drivers.camera.camera_source import CameraSource
from drivers.camera.exposure_choice import Exposure, ExposureChoice, ExposureRange

OLD_NS = 1_000_000_000
"""Age above which a sample says nothing any more."""
UNKNOWN_RAD_S = 0.5
"""Angle per second by which the image is taken to turn where nothing is heard: half a radian is
what a copter turns by in a gust or a corner."""
LEAST_HEIGHT_M = 2.0
"""Nearest that the ground is taken to be where no rangefinder says so."""


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
            self.remark = left_to_itself(source.name, "only v4l2 and gstreamer cameras can be set")
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
        if self._source is not None:  # of others nothing is asked
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


class ImageSpeed:
    """Telemetry in, angle per second out. Samples come in one thread, questions in another."""

    def __init__(self) -> None:
        self._turn: tuple[int, float] | None = None
        """Time and rate of turn, rad/s; the others likewise."""
        self._speed_m_s: tuple[int, float] | None = None
        self._height_m: tuple[int, float] | None = None
        self._range_m: tuple[int, float] | None = None
        self._lowest_m = math.inf

    def take(self, sample: Telemetry) -> None:
        """Add a sample; other kinds are left aside."""
        if isinstance(sample, ImuSample):
            self._turn = sample.t_ns, float(np.linalg.norm(sample.gyro_rad_s))
        elif isinstance(sample, AttitudeSample) and sample.rates_body_rad_s is not None:
            self._turn = sample.t_ns, float(np.linalg.norm(sample.rates_body_rad_s))
        elif isinstance(sample, RangeSample):
            self._range_m = sample.t_ns, sample.distance_m
        elif isinstance(sample, PositionSample):
            up_m = -float(sample.position_ned_m[2])
            self._lowest_m = min(self._lowest_m, up_m)
            self._height_m = sample.t_ns, max(up_m - self._lowest_m, LEAST_HEIGHT_M)
            if sample.velocity_ned_m_s is not None:
                self._speed_m_s = sample.t_ns, float(np.linalg.norm(sample.velocity_ned_m_s))

    def at(self, t_ns: int) -> float:
        """Angle by which the image moves in a second at `t_ns`, rad/s: by turn and by way.

        A turn that is unknown is taken as `UNKNOWN_RAD_S`, a way that is unknown as none.
        """
        turn, speed_m_s = _recent(self._turn, t_ns), _recent(self._speed_m_s, t_ns)
        distance_m = _recent(self._range_m, t_ns) or _recent(self._height_m, t_ns)
        by_way = speed_m_s / max(distance_m, 0.1) if speed_m_s and distance_m else 0.0
        return (UNKNOWN_RAD_S if turn is None else turn) + by_way


def left_to_itself(name: str, why: str) -> str:
    """Remark about a camera that does not let its exposure be chosen."""
    return f'{name}: camera.exposure = "tracking": {why}; it is left to its own exposure'


def _recent(known: tuple[int, float] | None, t_ns: int) -> float | None:
    """The value, where it is young and a number."""
    if known is None or t_ns - known[0] > OLD_NS or not math.isfinite(known[1]):
        return None
    return known[1]
