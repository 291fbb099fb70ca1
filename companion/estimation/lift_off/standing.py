"""Judge of standing still on the ground: then velocity is zero, and the place fixed.

A hover looks the same to a camera and to accelerometers, so neither may say so alone: the autopilot
must say that it is on the ground (disarmed, or by its landing detector), and accelerometers, gyro,
attitude and image must agree that nothing moves.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import cv2
import numpy as np

from companion.geometry.geodesy import STANDARD_GRAVITY_M_S2
from companion.geometry.transforms import Array, rotation_from_quaternion
from companion.messages import Bytes
from companion.telemetry import ArmedSample, AttitudeSample, ImuSample, LandedSample, Telemetry

STILL_NS = 1_000_000_000
"""All agree for so long first."""
LANDED_NS = 2_500_000_000
"""A landed state is that old at most: autopilots tell it once a second."""
FRESH_NS = 300_000_000
"""Age of the newest IMU sample and attitude at the time of a frame."""
LEAST_SAMPLES = 20


class Limits(NamedTuple):
    """Limits of what accelerometers, gyro, attitude and image of a standing vehicle may show.

    Turn: bias of a gyro that is not calibrated yet, 1 degree/s, and noise of the mean. Tilt: change
    of attitude in a second, of the tilt that an autopilot finds at rest, too. Change: between the
    means of two half seconds, beside what their noise explains. Gravity: bias and sensitivity of an
    accelerometer, and gravity on earth. Shift: of the image at `WIDTH_PX` in `ANCHOR_NS`; 0.25 is 1
    pixel of 640, some tenths of a millimetre on the ground below a landing gear. A heading may
    jump: autopilots align it anew on the ground, PX4 by 6 degrees in its simulator.
    """

    turn_rad_s: float
    tilt_rad: float
    change_m_s2: float
    gravity_m_s2: float
    shift_px: float


TO_BEGIN = Limits(0.03, float(np.radians(0.5)), 0.15, 0.6, 0.25)
TO_GO_ON = Limits(0.15, float(np.radians(4.0)), 1.0, 1.5, 2.0)
"""Motors that are started shake the vehicle on its gear, and its autopilot's attitude: PX4's turned
by 1.2 degrees in its simulator, on the ground, the vehicle by 0.2. As long as the image hardly
moves, and the autopilot says that it is on the ground, that is no lift-off."""
WIDTH_PX = 160
"""Width of the compared images: noise is averaged away, and a blurred image shows as much."""
MAX_GAIN_CHANGE = 0.3
"""By exposure; more is another image, or none."""
ANCHOR_NS = 2_000_000_000
"""The image is compared with one that old at most: light changes."""
LEAST_CONTRAST = 2.0
"""Ratio of the image's gradient to what changes without motion, per pixel: 0.5 in nothing but
noise, whose own gradients would say that nothing moves."""


class Standing:
    """Telemetry and images in; whether the vehicle stands still on the ground at each image."""

    def __init__(self) -> None:
        self._armed: bool | None = None
        self._landed: LandedSample | None = None
        self._imu: deque[ImuSample] = deque()
        self._attitudes: deque[AttitudeSample] = deque()
        self._image = ImageStillness()
        self._since_ns: int | None = None

    def take(self, sample: Telemetry) -> None:
        """Add a sample that is believed."""
        if isinstance(sample, ArmedSample):
            self._armed = sample.armed
        elif isinstance(sample, LandedSample):
            self._landed = sample
        elif isinstance(sample, ImuSample):
            self._imu.append(sample)
            while sample.t_ns - self._imu[0].t_ns > STILL_NS:
                self._imu.popleft()
        elif isinstance(sample, AttitudeSample):
            self._attitudes.append(sample)
            while sample.t_ns - self._attitudes[0].t_ns > STILL_NS:
                self._attitudes.popleft()

    @property
    def armed(self) -> bool:
        """True unless the autopilot has said that it is disarmed."""
        return self._armed is not False

    def at(self, t_ns: int, grey: Bytes) -> bool:
        """True if it stands at an image, which is the newest; also keeps that for the next."""
        stood = self._since_ns is not None and t_ns - self._since_ns >= STILL_NS
        limits = TO_GO_ON if stood else TO_BEGIN
        still = (
            self._on_ground(t_ns)
            and self._imu_still(t_ns, limits)
            and self._attitude_still(t_ns, limits)
        )
        if not still:
            self._image.clear()
        elif not self._image.still(t_ns, grey, limits.shift_px):
            still = False
        if not still:
            self._since_ns = None
            return False
        self._since_ns = t_ns if self._since_ns is None else self._since_ns
        return t_ns - self._since_ns >= STILL_NS

    def _on_ground(self, t_ns: int) -> bool:
        landed = self._landed
        if landed is not None and landed.landed and t_ns - landed.t_ns < LANDED_NS:
            return True
        return self._armed is False

    def _imu_still(self, t_ns: int, limits: Limits) -> bool:
        samples = self._imu
        if len(samples) < LEAST_SAMPLES or t_ns - samples[-1].t_ns > FRESH_NS:
            return False
        if samples[-1].t_ns - samples[0].t_ns < 0.8 * STILL_NS:
            return False
        gyro = np.array([each.gyro_rad_s for each in samples])
        accel = np.array([each.accel_m_s2 for each in samples])
        if not (np.isfinite(gyro).all() and np.isfinite(accel).all()):
            return False
        half = len(accel) // 2
        change = float(np.linalg.norm(accel[half:].mean(0) - accel[:half].mean(0)))
        noise = float(np.sqrt(np.diff(accel, axis=0).var(0).sum() / 2.0) * np.sqrt(2.0 / half))
        weight = float(np.linalg.norm(accel.mean(0)))
        return (
            float(np.linalg.norm(gyro.mean(0))) < limits.turn_rad_s
            and change < limits.change_m_s2 + 2.0 * noise
            and abs(weight - STANDARD_GRAVITY_M_S2) < limits.gravity_m_s2
        )

    def _attitude_still(self, t_ns: int, limits: Limits) -> bool:
        if len(self._attitudes) < 2 or t_ns - self._attitudes[-1].t_ns > FRESH_NS:
            return False
        first, last = (  # down in the body's axes; of the heading the gyro says what is true
            rotation_from_quaternion(each.ned_from_body)[2]
            for each in (self._attitudes[0], self._attitudes[-1])
        )
        return float(np.linalg.norm(np.cross(first, last))) < float(np.sin(limits.tilt_rad))


class ImageStillness:
    """Comparison of an image with one of a moment ago: whether it shows the same, unmoved.

    A shift and a change of size between the two are found by one step of Lucas and Kanade over the
    whole reduced image (Lucas and Kanade, 1981).
    """

    def __init__(self) -> None:
        self._anchor: _Anchor | None = None

    def clear(self) -> None:
        """Forget the image before."""
        self._anchor = None

    def still(self, t_ns: int, grey: Bytes, shift_px: float = TO_BEGIN.shift_px) -> bool:
        """Compare with the image before; False for the first, and where there is nothing to see."""
        small, anchor = _reduced(grey), self._anchor
        still = anchor is not None and anchor.shows(small, shift_px)
        if anchor is None or not still or t_ns - anchor.t_ns > ANCHOR_NS:
            self._anchor = _Anchor(t_ns, small)
        return still


class _Anchor:
    """A reduced image, and how it changes where the camera moves."""

    def __init__(self, t_ns: int, small: Array) -> None:
        self.t_ns, self._small = t_ns, small
        down, across = np.gradient(small)
        height, width = small.shape
        y, x = np.mgrid[:height, :width]
        growth = (across * (x - width / 2) + down * (y - height / 2)) / (width / 2)
        # the last column takes up a change of exposure
        self._changes = np.stack([each.ravel() for each in (across, down, growth, small)])
        self._inverse = np.linalg.pinv(self._changes @ self._changes.T)
        self._gradient = float(np.sqrt((across**2 + down**2).mean()))

    def shows(self, small: Array, most_px: float) -> bool:
        """True if another image shows the same, and there is enough in it to tell."""
        if small.shape != self._small.shape:
            return False
        difference = (small - self._small).ravel()
        across_px, down_px, growth_px, gain = self._inverse @ (self._changes @ difference)
        left = difference - np.array([across_px, down_px, growth_px, gain]) @ self._changes
        shift_px = float(np.hypot(across_px, down_px) + abs(growth_px))
        return bool(
            self._gradient > LEAST_CONTRAST * float(left.std())
            and abs(gain) < MAX_GAIN_CHANGE
            and shift_px < most_px
        )


def _reduced(grey: Bytes) -> Array:
    """A small image about its mean, float."""
    height = round(grey.shape[0] * WIDTH_PX / grey.shape[1])
    size = WIDTH_PX, height
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    blurred: Array = np.asarray(cv2.GaussianBlur(small, (0, 0), 1.5), np.float64)
    return np.asarray(blurred - blurred.mean())
