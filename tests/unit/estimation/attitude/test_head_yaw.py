"""A gimbal's yaw against the map: a drift and a jump are found, noise and turns are not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from companion.estimation.attitude.head_yaw import HeadYaw
from companion.geometry.transforms import rotation_from_vector, yaw_rotation

S = 10**9
TILT = rotation_from_vector(np.array([0.4, -0.2, 1.9]))
"""The map lies in any way."""


def first_s(
    yaw_deg: Callable[[float], float], until_s: float = 30.0
) -> tuple[float | None, HeadYaw]:
    """When the yaw is said to have moved, which it does by `yaw_deg` at a time."""
    rng, watch = np.random.default_rng(1), HeadYaw(float(np.radians(0.5)))
    for k in range(round(until_s * 15)):
        after_s = k / 15
        truth = yaw_rotation(0.8 * np.sin(0.5 * after_s)) @ rotation_from_vector(
            np.array([0.1 * np.sin(after_s), -0.9, 0.0])
        )
        noisy = truth @ rotation_from_vector(rng.normal(0, np.radians(0.3), 3))
        watch.take(
            round(after_s * S), TILT @ truth, yaw_rotation(np.radians(yaw_deg(after_s))) @ noisy
        )
        if watch.moved_since_ns() is not None:
            return after_s, watch
    return None, watch


def test_a_gimbal_that_tells_the_truth() -> None:
    found_s, watch = first_s(lambda _: 3.0)
    assert found_s is None and not watch.doubted


@pytest.mark.parametrize(("deg_s", "within_s"), [(1.0, 5.0), (-0.5, 9.0)])
def test_a_drift_is_found(deg_s: float, within_s: float) -> None:
    found_s, _ = first_s(lambda t_s: deg_s * max(0.0, t_s - 10.0))
    assert found_s is not None and 10.0 < found_s < 10.0 + within_s


def test_a_jump_is_doubted_at_once_and_said_within_half_a_second() -> None:
    def yaw_deg(t_s: float) -> float:
        return 40.0 if t_s > 10.0 else 0.0

    _, watch = first_s(yaw_deg, until_s=10.14)
    assert watch.doubted
    found_s, _ = first_s(yaw_deg)
    assert found_s is not None and found_s < 10.6


def test_it_fits_again_where_it_was_and_not_elsewhere() -> None:
    for back_deg, fits in ((0.0, True), (20.0, False)):
        found_s, watch = first_s(lambda t_s: 40.0 if t_s > 10.0 else 0.0)
        assert found_s is not None and not watch.fits_again(round(found_s * S))
        for k in range(100):
            t_ns = round((found_s + 0.1 * (k + 1)) * S)
            watch.take(t_ns, TILT, yaw_rotation(np.radians(back_deg)))
        assert watch.fits_again(t_ns) is fits


def test_in_another_map_it_has_to_be_steady() -> None:
    found_s, watch = first_s(lambda t_s: 40.0 if t_s > 10.0 else 0.0)
    assert found_s is not None
    watch.reset()
    fits = []
    for k in range(130):
        t_ns = round((found_s + 0.1 * (k + 1)) * S)
        watch.take(t_ns, np.eye(3), TILT)
        fits.append(watch.fits_again(t_ns))
    assert not any(fits[:80]) and fits[-1]
    watch.believe()
    assert watch.fits_again(t_ns) and not watch.doubted


def test_a_correction_of_the_heading_is_no_fault_of_the_gimbal() -> None:
    """PX4 turns its heading by some degrees a second after a take-off, and what is told with it."""
    for follows in (True, False):
        watch = HeadYaw(float(np.radians(0.5)))
        for k in range(300):
            corrected = np.radians(15.0) * min(max(0.0, (k - 100) / 50), 1.0)
            told = yaw_rotation(corrected if follows else 0.0)
            watch.take(k * S // 15, TILT, told, corrected)
            assert watch.moved_since_ns() is None and not watch.doubted
            assert watch.fits_again(k * S // 15)


def test_a_yaw_far_from_that_of_the_positions_is_found() -> None:
    for off_deg, found in ((10.0, False), (35.0, True)):
        watch, far = HeadYaw(float(np.radians(0.5))), []
        for k in range(60):
            t_ns = k * S // 15
            watch.take(t_ns, TILT, yaw_rotation(np.radians(off_deg)))
            far.append(watch.far_since_ns(t_ns, TILT.T))
        assert watch.far_since_ns(t_ns + S, None) is None
        assert [since for since in far if since is not None][:1] == ([0] if found else [])
        assert far[:15] == [None] * 15
