"""KLT tracking of map points where corners are not detected again."""

from __future__ import annotations

import cv2
import numpy as np

from companion.geometry.camera import Camera, Distortion
from companion.geometry.transforms import Array, Pose, rotation_from_vector
from companion.messages import Bytes
from companion.slam.features.klt_tracking import track_points
from tests.support.flights.rendered_flight import Terrain
from tests.support.flights.scene import DOWN_LOOKING

CAMERA = Camera(
    320, 240, 260.0, 258.0, 161.0, 118.0, Distortion.RADTAN, (-0.1, 0.02, 1e-3, -5e-4, 0.0)
)
TERRAIN = Terrain(3, plane=True)
FIRST = Pose(DOWN_LOOKING, np.array([0.0, 0.0, -2.0]))
SECOND = Pose(
    rotation_from_vector(np.array([0.05, -0.08, 0.2])) @ DOWN_LOOKING, np.array([0.15, -0.1, -1.5])
)


def blurred(picture: Bytes, seed: int) -> Bytes:
    """Out of focus and noisy."""
    noise = np.random.default_rng(seed).normal(scale=3.0, size=picture.shape)
    blurred = cv2.GaussianBlur(picture, (0, 0), 3.0)
    return np.asarray(np.clip(100 + 0.5 * (blurred - 128.0) + noise, 0, 255), np.uint8)


def seen(rng: np.random.Generator) -> Array:
    """Points on the ground that the first camera observes."""
    pixels = rng.uniform([20, 20], [300, 220], (120, 2))
    rays = np.c_[CAMERA.normalise(pixels), np.ones(120)] @ FIRST.rotation.T
    out: Array = FIRST.translation + rays * (2.0 / rays[:, 2:])
    return out


def test_low_contrast_image_from_much_closer_is_tracked(rng: np.random.Generator) -> None:
    grey = blurred(TERRAIN.picture(CAMERA, FIRST), 1)
    next_grey = blurred(TERRAIN.picture(CAMERA, SECOND), 2)
    guess = Pose(SECOND.rotation, SECOND.translation + [0.05, 0.08, -0.1]).inverse()
    found = track_points(CAMERA, seen(rng), grey, FIRST.inverse(), next_grey, guess)
    assert found is not None
    assert np.linalg.norm(found.inverse().translation - SECOND.translation) < 0.03
    assert np.array_equal(found.rotation, guess.rotation)


def test_another_scene_is_not_tracked(rng: np.random.Generator) -> None:
    grey = TERRAIN.picture(CAMERA, FIRST)
    elsewhere = Pose(SECOND.rotation, SECOND.translation + [20.0, 20.0, 0.0])
    next_grey = TERRAIN.picture(CAMERA, elsewhere)
    points = seen(rng)
    assert track_points(CAMERA, points, grey, FIRST.inverse(), next_grey, SECOND.inverse()) is None


def test_blank_image_and_too_few_points_are_not_tracked(rng: np.random.Generator) -> None:
    grey, points = TERRAIN.picture(CAMERA, FIRST), seen(rng)
    here, there = FIRST.inverse(), SECOND.inverse()
    blank = np.full_like(grey, 200)
    assert track_points(CAMERA, points, grey, here, blank, there) is None
    assert track_points(CAMERA, points, blank, here, grey, there) is None
    assert track_points(CAMERA, points[:10], grey, here, grey, here) is None
    behind = Pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3)) @ here
    assert track_points(CAMERA, points, grey, here, grey, behind) is None
