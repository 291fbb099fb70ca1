"""A mount of which nothing is known, found while the vehicle is turned by hand."""

from __future__ import annotations

import numpy as np
import pytest

from companion.estimation.attitude.mount_search import AXES, MountSearch, MountSearched
from companion.geometry.transforms import (
    Array,
    angle_between,
    quaternion_from_euler,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
    yaw_rotation,
)
from companion.telemetry import AttitudeSample
from tests.support.flights.scene import DOWN_LOOKING

MOUNTS = {
    "forward": np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    "down": DOWN_LOOKING,
    "upside down, backwards": rotation_from_vector(np.array([2.0, -1.3, 1.7])),
}
ALL = np.radians([35.0, 30.0, 40.0])


def searched(
    mount: Array, swing_rad: Array = ALL, late_s: float = 0.0, gimbal: bool = False
) -> MountSearched:
    """Half a minute of leaning and turning; with `gimbal` the camera keeps level."""
    rng, search = np.random.default_rng(3), MountSearch()
    for k in range(30 * 25):
        t_s = k / 25
        angles = swing_rad * np.sin(np.array([0.9, 1.1, 0.5]) * t_s + [0.0, 1.0, 2.0])
        body = rotation_from_quaternion(quaternion_from_euler(*angles))
        noisy = body @ rotation_from_vector(rng.normal(scale=0.002, size=3))
        stamp_ns = int((t_s + late_s) * 1e9) + 10**9
        search.add(AttitudeSample(stamp_ns, quaternion_from_rotation(noisy)))
        if k % 3 == 0:
            turned = yaw_rotation(angles[2]) if gimbal else body
            camera = yaw_rotation(0.7) @ turned @ mount
            camera = camera @ rotation_from_vector(rng.normal(scale=0.001, size=3))
            search.take(int(t_s * 1e9) + 10**9, camera, 0)
    return search.result()


@pytest.mark.parametrize("late_s", [0.0, 0.08])
@pytest.mark.parametrize("name", MOUNTS)
def test_any_mount_is_found(name: str, late_s: float) -> None:
    found = searched(MOUNTS[name], late_s=late_s)
    assert found.is_found and found.estimate is not None
    assert np.degrees(angle_between(found.estimate.body_from_camera, MOUNTS[name])) < 0.5
    assert found.estimate.offset_s == pytest.approx(late_s, abs=0.01)


@pytest.mark.parametrize("axis", range(3))
def test_an_axis_without_rotation_is_asked_for(axis: int) -> None:
    found = searched(MOUNTS["down"], np.where(np.arange(3) == axis, np.radians(2.0), ALL))
    assert AXES[axis] in found.missing
    assert not found.is_found


def test_rotation_about_one_axis_tells_no_mount() -> None:
    found = searched(MOUNTS["down"], np.array([0.0, 0.0, ALL[2]]))
    assert not found.is_certain


def test_a_gimbal_is_not_a_mount() -> None:
    assert not searched(MOUNTS["down"], gimbal=True).is_certain


def test_another_map_begins_a_new_search() -> None:
    search = MountSearch()
    for k in range(60):
        search.add(AttitudeSample(k * 10**8, np.array([1.0, 0.0, 0.0, 0.0])))
        search.take(k * 10**8, np.eye(3), k // 30)
    assert len(search) < 25
