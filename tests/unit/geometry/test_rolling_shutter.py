"""A rolling shutter is undone: rays with exact row times, and rendered images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from companion.geometry.camera import Camera, Distortion
from companion.geometry.rolling_shutter import RowTimes, Unrolling, shutter_motion
from companion.geometry.transforms import Array, Pose, rotation_from_vector
from tests.support.flights.rolling_scene import rolled
from tests.support.flights.scene import DOWN_LOOKING, PlaneWorld

READOUT_S = 0.025
RATES = np.array([0.6, -2.5, 0.9])
"""150 degrees/s and more."""
RADTAN = Camera(320, 240, 240.0, 239.5, 161.0, 118.0, Distortion.RADTAN, (-0.16, 0.05, 6e-4, 0, 0))
FISHEYE = Camera(320, 240, 170.0, 170.0, 160.0, 121.0, Distortion.EQUIDISTANT, (0.01, 0, 0, 0))
CAMERAS = pytest.mark.parametrize("camera", [RADTAN, FISHEYE], ids=["radtan", "fisheye"])


def seen_by_search(camera: Camera, ray: Array) -> Array:
    """Pixel of a ray at that time of the readout at which its own row is exposed."""
    times = np.linspace(-0.6, 0.6, 401) * READOUT_S
    rays = np.stack([rotation_from_vector(RATES * t).T @ [*ray, 1.0] for t in times])
    pixels = camera.project(rays)
    own = (pixels[:, 1] / (camera.height - 1) - 0.5) * READOUT_S
    late = times - own  # rises
    return np.array([np.interp(0.0, late, pixels[:, k]) for k in range(2)])


@CAMERAS
def test_rays_are_seen_where_their_own_row_is_exposed(camera: Camera) -> None:
    pixels = np.array([[20.0, 15.0], [300.0, 20.0], [160.0, 120.0], [30.0, 225.0], [290.0, 220.0]])
    rays = camera.normalise(pixels)
    seen = RowTimes(camera, READOUT_S).seen_at(rays, shutter_motion(RATES))
    expected = np.stack([seen_by_search(camera, ray) for ray in rays])
    np.testing.assert_allclose(seen, expected, atol=0.01)
    assert np.abs(seen - pixels).max() > 5.0, "ignored it is an error of many pixels"
    unrolling = Unrolling(camera, READOUT_S)
    np.testing.assert_allclose(unrolling.seen(pixels, shutter_motion(RATES)), seen, atol=1e-4)


@CAMERAS
def test_an_image_becomes_that_of_a_global_shutter(camera: Camera) -> None:
    world = PlaneWorld(np.random.default_rng(3))
    at = Pose(DOWN_LOOKING, np.array([0.0, 0.0, -12.0]))

    def pose_at(t_s: float) -> Pose:
        return Pose(at.rotation @ rotation_from_vector(RATES * t_s), at.translation)

    still = world.render(camera, at)[0].astype(float)
    image = rolled(world, camera, pose_at, READOUT_S)
    undone = Unrolling(camera, READOUT_S).image(image, shutter_motion(RATES))
    inside = np.s_[20:-20, 20:-20]  # what the rolling shutter did not see lies at the rim
    before = np.abs(image - still)[inside].mean()
    after = np.abs(undone - still)[inside].mean()
    assert before > 6.0, "grey levels"
    assert after < 0.15 * before


def test_the_way_is_undone_before_a_plane() -> None:
    world = PlaneWorld(np.random.default_rng(3))
    place = np.array([0.0, 0.0, -12.0])
    at = Pose(DOWN_LOOKING @ rotation_from_vector(np.array([0.3, 0.1, 0.0])), place)
    velocity = np.array([9.0, -6.0, 3.0])  # of the camera, in its axes

    def pose_at(t_s: float) -> Pose:
        turned = at.rotation @ rotation_from_vector(RATES * t_s)
        return Pose(turned, at.translation + at.rotation @ velocity * t_s)

    still = world.render(RADTAN, at)[0].astype(float)
    image = rolled(world, RADTAN, pose_at, READOUT_S)
    down = at.rotation.T @ [0.0, 0.0, 1.0]
    unrolling = Unrolling(RADTAN, READOUT_S)
    errors = []
    for motion in (shutter_motion(RATES), shutter_motion(RATES, velocity, down / 12.0)):
        undone = unrolling.image(image, motion)
        errors.append(np.abs(undone - still)[25:-25, 25:-25].mean())
    assert errors[1] < 0.6 * errors[0], "of houses it is only about right"


def test_an_image_is_left_alone_while_the_camera_hardly_turns() -> None:
    image = np.random.default_rng(1).integers(0, 256, (240, 320), np.uint8)
    unrolling = Unrolling(RADTAN, READOUT_S)
    assert unrolling.image(image, shutter_motion(np.full(3, 0.01))) is image
    assert unrolling.image(image, shutter_motion(np.full(3, 0.5))) is not image


def test_rates_that_no_camera_has_do_no_harm() -> None:
    image = np.full((240, 320), 7, np.uint8)
    for rates in (np.full(3, 100.0), np.array([0.0, 1e5, 0.0])):
        assert Unrolling(RADTAN, READOUT_S).image(image, shutter_motion(rates)).shape == image.shape


def test_odd_sizes() -> None:
    camera = replace(RADTAN, width=333, height=227, readout_ms=25.0)
    image = np.zeros((227, 333, 3), np.uint8)
    assert Unrolling(camera, READOUT_S).image(image, shutter_motion(RATES)).shape == image.shape
