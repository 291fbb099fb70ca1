"""Standing on the ground is stated only where autopilot, IMU, attitude and image all agree."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from companion.estimation.lift_off.standing import ImageStillness, Standing
from companion.geometry.transforms import Array, quaternion_from_euler, rotation_from_vector
from companion.messages import Bytes
from companion.telemetry import ArmedSample, AttitudeSample, ImuSample, LandedSample

REST_M_S2 = np.array([0.0, 0.0, -9.80665])
MS = 1_000_000
Ground = Callable[[float], Array]


def ground(blur_px: float = 1.0, contrast: float = 40.0) -> Bytes:
    """Grass from above, 640x480."""
    rng = np.random.default_rng(1)
    coarse = cv2.GaussianBlur(rng.normal(size=(480, 640)), (0, 0), 6.0 * blur_px)
    image = 110.0 + contrast * coarse / coarse.std()
    return np.asarray(np.clip(image, 0, 255), np.uint8)


GRASS = ground()


def seen(shift_px: float = 0.0, grow: float = 1.0, gain: float = 1.0, seed: int = 0) -> Bytes:
    """The ground after a motion of the camera, with noise."""
    turn = np.array([[grow, 0.0, shift_px], [0.0, grow, 0.0]])
    moved = cv2.warpAffine(GRASS, turn, (640, 480), borderMode=cv2.BORDER_REFLECT)
    noise = np.random.default_rng(seed).normal(scale=3.0, size=moved.shape)
    return np.asarray(np.clip(gain * moved + noise, 0, 255), np.uint8)


STILL = [seen(seed=k) for k in range(7)]


class Vehicle:
    """Samples and images of 30 frames a second, until a change begins after three seconds."""

    def __init__(self) -> None:
        self.armed: bool | None = False
        self.landed: bool | None = None
        self.tilt_rad_s = 0.0
        self.gyro_rad_s = 0.01
        self.accelerated_m_s2 = 0.0
        self.vibration_m_s2 = 0.1
        self.shift_px_s = 0.0
        self.grow_s = 0.0
        self.image: Bytes | None = None
        self.imu_hz = 100
        self.heading_rad = 1.0

    def stands(self, seconds: float, change: Callable[[Vehicle], None] | None = None) -> list[bool]:
        """Whether it was said to stand, frame by frame."""
        standing, rng, found = Standing(), np.random.default_rng(3), []
        if self.armed is not None:
            standing.take(ArmedSample(0, self.armed))
        last_ms = -1
        for k in range(int(30 * seconds)):
            t_ms = round(k * 1000 / 30)
            if change is not None and k == 90:
                change(self)
            for ms in range(last_ms + 1, t_ms + 1):
                moving_s = max(ms * 1e-3 - 3.0, 0.0)
                if self.landed is not None and ms % 1000 == 0:
                    standing.take(LandedSample(ms * MS, self.landed))
                if ms % 20 == 0:
                    q = quaternion_from_euler(0.02, self.tilt_rad_s * moving_s, self.heading_rad)
                    standing.take(AttitudeSample(ms * MS, q))
                if ms % (1000 // self.imu_hz) == 0:
                    force = REST_M_S2 + [0.1, -0.05, 0.08]
                    force = force + rng.normal(scale=self.vibration_m_s2, size=3)
                    force[0] += self.accelerated_m_s2 * (moving_s > 0)
                    gyro = np.array([0.0, self.gyro_rad_s, 0.0])
                    standing.take(ImuSample(ms * MS, gyro, force))
            last_ms, moving_s = t_ms, max(t_ms * 1e-3 - 3.0, 0.0)
            image = self.image
            if image is None:
                moves = moving_s and (self.shift_px_s or self.grow_s)
                by = self.shift_px_s * moving_s, 1.0 + self.grow_s * moving_s
                image = seen(*by, seed=k) if moves else STILL[k % len(STILL)]
            found.append(standing.at(t_ms * MS, image))
        return found


def _set(name: str, value: object) -> Callable[[Vehicle], None]:
    return lambda vehicle: setattr(vehicle, name, value)


def test_it_stands_once_all_agree_for_a_while() -> None:
    found = Vehicle().stands(3.0)
    assert not any(found[:45]) and all(found[75:])


def test_motors_that_idle_do_not_matter() -> None:
    """Armed, on the ground by the landing detector; vibration of 0.5 m/s2, aliased."""
    vehicle = Vehicle()
    vehicle.armed, vehicle.landed, vehicle.vibration_m_s2 = True, True, 0.5
    found = vehicle.stands(6.0)
    assert np.mean(found[90:]) > 0.95


def _shaken(vehicle: Vehicle) -> None:
    vehicle.armed, vehicle.landed = True, True
    vehicle.vibration_m_s2, vehicle.accelerated_m_s2, vehicle.tilt_rad_s = 1.1, 0.3, 0.02


def test_motors_that_shake_it_as_they_start_end_no_stand() -> None:
    """The autopilot's attitude turns by a degree a second meanwhile, the image does not move."""
    assert np.mean(Vehicle().stands(5.0, _shaken)[90:]) > 0.95


def test_a_heading_that_is_aligned_anew_ends_no_stand() -> None:
    """PX4's jumps by 6 degrees on the ground; the gyro says that nothing turns."""
    assert all(Vehicle().stands(5.0, _set("heading_rad", 1.4))[75:])


@pytest.mark.parametrize(("armed", "landed"), [(True, None), (None, None), (True, False)])
def test_a_hover_is_no_stand(armed: bool | None, landed: bool | None) -> None:
    """Nor a restart while armed, whatever IMU and image show."""
    vehicle = Vehicle()
    vehicle.armed, vehicle.landed = armed, landed
    assert not any(vehicle.stands(4.0))


@pytest.mark.parametrize(
    ("change", "within_s"),
    [
        (_set("shift_px_s", 20.0), 0.6),  # carried about, or sliding
        (_set("grow_s", -0.2), 0.3),  # straight up above the ground
        (_set("accelerated_m_s2", 2.5), 0.5),
        (_set("tilt_rad_s", 0.15), 0.6),
        (_set("gyro_rad_s", 0.4), 0.5),
        (_set("image", np.full((480, 640), 100, np.uint8)), 0.1),  # a cover over the lens
    ],
)
def test_each_motion_ends_it(change: Callable[[Vehicle], None], within_s: float) -> None:
    found = Vehicle().stands(4.5, change)
    assert found[88]
    assert not any(found[90 + int(30 * within_s) :])


def test_a_landing_detector_that_fell_silent_is_not_believed() -> None:
    vehicle = Vehicle()
    vehicle.armed, vehicle.landed = True, True
    found = vehicle.stands(8.0, _set("landed", None))
    assert found[88] and not any(found[-40:])


@pytest.mark.parametrize("hz", [0.5, 10])
def test_too_few_accelerations_say_nothing(hz: float) -> None:
    vehicle = Vehicle()
    vehicle.imu_hz = hz  # type: ignore[assignment]
    assert not any(vehicle.stands(4.0))


def test_an_image_without_contrast_says_nothing() -> None:
    """In nothing but noise, nothing seems to move."""
    stillness, rng = ImageStillness(), np.random.default_rng(0)
    for k in range(30):
        dark = np.clip(rng.normal(12.0, 3.0, (480, 640)), 0, 255).astype(np.uint8)
        assert not stillness.still(k * 33 * MS, dark)


def test_a_change_of_exposure_is_no_motion() -> None:
    stillness = ImageStillness()
    found = [stillness.still(k * 33 * MS, seen(gain=1.0 + 0.01 * k, seed=k)) for k in range(30)]
    assert not found[0] and all(found[1:])


def test_rotation_of_small_angle_is_seen() -> None:
    """A pan of 0.2 degrees moves the image by 2 of 640 pixels."""
    shift_px = 560.0 * float(rotation_from_vector(np.array([0.0, np.radians(0.2), 0.0]))[0, 2])
    stillness = ImageStillness()
    assert not stillness.still(0, seen(seed=1))
    assert stillness.still(33 * MS, seen(seed=2))
    assert not stillness.still(66 * MS, seen(shift_px, seed=3))
