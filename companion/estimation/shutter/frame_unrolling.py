"""Frames of a rolling shutter, corrected to that of a global one by the rotation of the camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from companion.estimation.attitude.camera_attitude import CameraAttitude
from companion.estimation.motion_filter import MotionFilter
from companion.geometry.camera import Camera
from companion.geometry.rolling_shutter import Unrolling
from companion.geometry.transforms import Array
from companion.messages import Frame, Warned

LEAST_HALF_SPAN_NS = 5_000_000
"""Attitudes are rounded to microradians and stamped to a millisecond or two: over less their
difference is mostly that."""
BY_IMAGES = "rolling shutter is undone by the rotation between images alone"
BY_IMAGES_WHY = (
    "the autopilot's attitude is not that of the camera, or none comes: quick starts and stops of "
    "a turn are undone late"
)


class FrameUnrolling:
    """Undoes the rotation of the camera during the readout of each frame.

    By the autopilot's attitude, or where that is not the camera's by the rotation between the last
    two images, which is said once; while neither is known a frame stays as it is.
    """

    def __init__(self, camera: Camera) -> None:
        assert camera.readout_ms
        self._unrolling = Unrolling(camera, 1e-3 * camera.readout_ms)
        self._half_span_ns = max(round(0.5e6 * camera.readout_ms), LEAST_HALF_SPAN_NS)
        self._warnings: list[Warned] = []
        self._reported = False

    def unrolled(
        self, frame: Frame, attitude: CameraAttitude, motion: MotionFilter
    ) -> tuple[Frame, Array | None]:
        """The frame as a global shutter would have taken it, and the rate (3,) rad/s used."""
        rates = attitude.rates_at(frame.t_ns, self._half_span_ns)
        if rates is None:
            rates = motion.rates_camera_rad_s
            if rates is not None and not self._reported:
                self._reported = True
                self._warnings.append(Warned(frame.t_ns, BY_IMAGES, BY_IMAGES_WHY))
        if rates is None or not np.isfinite(rates).all():
            return frame, None
        return replace(frame, grey=self._unrolling.image(frame.grey, rates)), rates

    def warnings(self) -> list[Warned]:
        """Warnings since the last call."""
        given, self._warnings = self._warnings, []
        return given
