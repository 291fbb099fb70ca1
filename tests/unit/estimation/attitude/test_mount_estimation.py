"""Mount error and stamp delay from rotations alone."""

from __future__ import annotations

import numpy as np
import pytest

from companion.estimation.attitude.attitude_history import AttitudeHistory
from companion.estimation.attitude.mount_estimation import MountEstimate, MountEstimator
from companion.geometry.transforms import (
    Array,
    angle_between,
    quaternion_from_rotation,
    rotation_from_vector,
    yaw_rotation,
)
from companion.telemetry import AttitudeSample
from tests.support.flights.scene import DOWN_LOOKING

SECONDS = 20.0


def attitude(t_s: float) -> Array:
    """Turns of a survey with some wind."""
    yaw = 1.2 * np.sin(0.35 * t_s) + 0.3 * np.sin(1.1 * t_s)
    tilt = np.array([0.12 * np.sin(0.9 * t_s), 0.1 * np.sin(0.7 * t_s + 1), 0.0])
    return yaw_rotation(yaw) @ rotation_from_vector(tilt)


def estimated(askew: Array, late_s: float, still: bool = False) -> MountEstimate | None:
    rng = np.random.default_rng(2)
    history = AttitudeHistory()
    estimator = MountEstimator(DOWN_LOOKING)
    true_mount = DOWN_LOOKING @ rotation_from_vector(askew)
    drift = np.zeros(3)
    for k in range(int(SECONDS * 25)):
        t_s = k / 25
        drift += rng.normal(scale=0.0005, size=3) / 25
        noise = rotation_from_vector(drift + rng.normal(scale=0.0015, size=3))
        body = np.eye(3) if still else attitude(t_s)
        stamp_ns = int((t_s + late_s) * 1e9) + 10**9
        history.add(AttitudeSample(stamp_ns, quaternion_from_rotation(noise @ body)))
        if k % 3 == 0:
            camera = yaw_rotation(0.4) @ body @ true_mount
            camera = camera @ rotation_from_vector(rng.normal(scale=0.0005, size=3))
            estimator.take(int(t_s * 1e9) + 10**9, camera, history)
    return estimator.estimate()


@pytest.mark.parametrize("late_s", [0.0, 0.06, -0.04])
def test_mount_error_and_delay_are_estimated(late_s: float) -> None:
    askew = np.radians([1.8, -2.0, 1.5])
    found = estimated(askew, late_s)
    assert found is not None
    assert found.certain
    wanted = DOWN_LOOKING @ rotation_from_vector(askew)
    assert np.degrees(angle_between(found.body_from_camera, wanted)) < 0.5
    assert found.offset_s == pytest.approx(late_s, abs=0.008)
    assert np.degrees(found.sigma_turn_rad).max() < 0.5
    assert found.sigma_offset_s < 0.01


@pytest.mark.parametrize(
    "off_deg, fits",
    [(0.0, True), (1.0, True), (3.0, False), (20.0, False), (90.0, False), (180.0, False)],
)
def test_a_mount_fits_within_what_can_be_measured_by_hand(off_deg: float, fits: bool) -> None:
    found = estimated(np.radians([0.0, 0.6 * off_deg, 0.8 * off_deg]), 0.03)
    assert found is not None and found.fits == fits


def test_without_rotation_nothing_is_concluded() -> None:
    found = estimated(np.radians([3.0, 0, 0]), 0.05, still=True)
    assert found is not None
    assert not found.certain and not found.fits


def test_too_little_data_gives_none() -> None:
    assert MountEstimator(DOWN_LOOKING).estimate() is None
