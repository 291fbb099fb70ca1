"""Depths of a stereo pair against those of drawn ground."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from companion.errors import FlightError
from companion.geometry.camera import Camera
from companion.geometry.transforms import Pose, rotation_from_vector
from drivers.images.stereo_pair import Depths, StereoPair
from tests.support.flights.rendered_flight import CAMERA_DOWN, Terrain
from tests.support.flights.scene import leaves
from tests.support.flights.stereo_flight import FIRST, FIRST_FROM_SECOND, SECOND, SIGMA_GREY

LEANING = Pose(rotation_from_vector(np.array([0.2, -0.15, 0.4])), np.array([1.0, 2.0, -8.0]))
"""`ned_from_body` over ground that is a plane at 0."""


def mounted(
    rotation_rad: tuple[float, float, float], place_m: tuple[float, float, float]
) -> Camera:
    apart = Pose(rotation_from_vector(np.array(rotation_rad)), np.array(place_m))
    return replace(SECOND, body_from_camera=CAMERA_DOWN @ apart)


def seen(camera: Camera, seed: int) -> np.ndarray:
    assert camera.body_from_camera is not None
    grey = Terrain(3, plane=True, pattern=leaves).picture(camera, LEANING @ camera.body_from_camera)
    noisy = grey + np.random.default_rng(seed).normal(0.0, SIGMA_GREY, grey.shape)
    return np.asarray(np.clip(noisy, 0, 255), np.uint8)


def measured(second: Camera, stated: Camera | None = None) -> Depths:
    return StereoPair(FIRST, stated or second).depths(seen(FIRST, 1), seen(second, 2))


def true_depth_m(pixels: np.ndarray) -> np.ndarray:
    assert FIRST.body_from_camera is not None
    pose = LEANING @ FIRST.body_from_camera
    rays = np.c_[FIRST.normalise(pixels), np.ones(len(pixels))] @ pose.rotation.T
    return np.asarray(-pose.translation[2] / rays[:, 2])


@pytest.mark.parametrize(
    "second",
    [
        SECOND,
        mounted((0.0, 0.0, 0.0), (-0.3, 0.0, 0.0)),  # on the other side
        mounted((0.02, 0.0, 0.01), (0.0, 0.3, 0.0)),  # one below the other
        mounted((0.0, 0.0, np.pi / 2), (0.3, 0.0, 0.0)),  # turned in its place
        mounted((0.0, -0.4, 0.0), (0.6, 0.0, 0.0)),  # converging
    ],
)
def test_depths_are_right_within_what_they_state(second: Camera) -> None:
    found = measured(second)
    off = found.depth_m / true_depth_m(found.pixels) - 1.0
    relative = found.sigma_m / found.depth_m
    print(len(off), np.median(off), np.percentile(np.abs(off) / relative, 68))
    assert len(off) >= 30
    assert abs(np.median(off)) < 0.004
    assert np.percentile(np.abs(off) / relative, 68) < 1.2
    assert found.off_line_px < 0.15


def test_a_camera_that_is_turned_otherwise_than_stated_is_seen() -> None:
    wrong = mounted((0.015, -0.02, 0.015), (0.3, 0.01, -0.02))
    found = measured(SECOND, wrong)
    assert found.off_line_px > 0.7


def test_what_only_one_camera_sees_has_no_depth() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (240, 320)).astype(np.uint8)
    assert len(StereoPair(FIRST, SECOND).depths(seen(FIRST, 1), noise).depth_m) == 0
    plain = np.full((240, 320), 90, np.uint8)
    assert len(StereoPair(FIRST, SECOND).depths(plain, plain).depth_m) == 0


@pytest.mark.parametrize(
    ("second", "said"),
    [
        (mounted((0.0, 1.5, 0.0), (0.3, 0.0, 0.0)), "do not look at the same things"),
        (mounted((0.0, 0.0, 0.0), (0.0, 0.0, 0.3)), "behind the other"),
        (replace(SECOND, body_from_camera=FIRST.body_from_camera), "from two places"),
        (replace(SECOND, body_from_camera=None), "mount of both"),
    ],
)
def test_what_is_no_stereo_pair_is_refused(second: Camera, said: str) -> None:
    with pytest.raises(FlightError, match=said):
        StereoPair(FIRST, second)


def test_the_baseline_is_that_of_the_mounts() -> None:
    expected = np.linalg.norm(FIRST_FROM_SECOND.translation)
    assert StereoPair(FIRST, SECOND).baseline_m == pytest.approx(float(expected))
