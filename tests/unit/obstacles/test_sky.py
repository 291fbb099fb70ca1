"""Sky is far though it has no depth; what might be a thing is none."""

from __future__ import annotations

import numpy as np
import pytest

from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose, rotation_from_vector
from companion.messages import Bytes
from companion.obstacles.newest_sight import NEAR_BY_RAD
from companion.obstacles.sky import sky_rays

AHEAD = Pose(np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.zeros(3))
CAMERA = Camera(640, 480, 500.0, 500.0, 319.5, 239.5, body_from_camera=AHEAD)
SKY_GREY = 190
HORIZON = 240


def picture() -> Bytes:
    """Sky with a gradient and noise over a patterned land."""
    rng = np.random.default_rng(3)
    grey = rng.uniform(40, 160, (480, 640))
    rows = np.arange(HORIZON)[:, None]
    grey[:HORIZON] = SKY_GREY + 20 * rows / HORIZON + rng.normal(0, 2, (HORIZON, 640))
    return np.asarray(np.rint(grey), np.uint8)


def corners(least: int = 0, most: int = 640) -> Array:
    """All over the land, in these columns."""
    u, v = np.meshgrid(np.arange(least + 4, most, 9), np.arange(HORIZON + 4, 480, 9))
    return np.stack([u.ravel(), v.ravel()], 1).astype(float)


def seen(
    grey: Bytes, far: Array, near: Array | None = None, pose: Pose = AHEAD
) -> tuple[Array, Array]:
    """Pixels of the rays."""
    none = np.zeros((0, 2))
    rays = sky_rays(grey, CAMERA, pose, far, none if near is None else near, NEAR_BY_RAD)
    pixels = CAMERA.project(rays @ pose.rotation)
    return pixels[:, 0], pixels[:, 1]


def test_sky_over_far_land() -> None:
    u, v = seen(picture(), corners())
    assert len(u) > 2000 and v.max() < HORIZON
    assert v.max() > HORIZON - 24 and v.min() < 8 and u.min() < 8 and u.max() > 630


@pytest.mark.parametrize("turned", [180.0, 20.0])
def test_upside_down_and_rolled(turned: float) -> None:
    """The other edge of the picture is up; where it rolls a little it is the same."""
    grey = picture()[::-1, ::-1].copy() if turned == 180.0 else picture()
    pose = AHEAD @ Pose(rotation_from_vector(np.radians([0, 0, turned])), np.zeros(3))
    far = 639.0 - corners() if turned == 180.0 else corners()
    far = far - [0, 160.0] if turned == 180.0 else far
    u, _ = seen(grey, far, pose=pose)
    assert len(u) > 2000


def test_what_looks_down_sees_no_sky() -> None:
    down = Pose(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.zeros(3))
    assert len(seen(picture(), corners(), pose=down)[0]) == 0


def test_a_smooth_wall_that_stands_near_is_none() -> None:
    """Where it stands on the ground that is as near as it."""
    u, _ = seen(picture(), corners(), corners(least=300)[::5])
    assert len(u) > 800 and u.max() < 300


def test_over_what_is_not_known_to_be_far_is_none() -> None:
    u, _ = seen(picture(), corners(most=320))
    assert len(u) > 800 and u.max() < 345


def test_a_picture_of_nothing_has_none() -> None:
    assert len(seen(np.full((480, 640), 200, np.uint8), corners())[0]) == 0


def test_what_is_darker_than_the_land_is_none() -> None:
    grey = picture()
    grey[:HORIZON] -= 130
    assert len(seen(grey, corners())[0]) == 0


def test_a_narrow_thing_that_hangs_in_before_far_land_is_none() -> None:
    rng = np.random.default_rng(3)
    grey = rng.integers(40, 160, (480, 640)).astype(np.uint8)
    grey[:HORIZON, 250:350] = SKY_GREY
    u, v = np.meshgrid(np.arange(4, 640, 9), np.arange(4, 480, 9))
    far = np.stack([u.ravel(), v.ravel()], 1).astype(float)
    assert len(seen(grey, far)[0]) == 0


@pytest.mark.parametrize("wide_px", [1, 30])
def test_a_thing_before_the_sky_is_none(wide_px: int) -> None:
    grey = picture()
    grey[:HORIZON, 320 : 320 + wide_px] = 110
    u, _ = seen(grey, corners())
    assert len(u) > 2000
    assert not ((u > 314) & (u < 326 + wide_px)).any()
