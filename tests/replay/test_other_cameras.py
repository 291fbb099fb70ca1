"""Cameras that differ from the usual one, each on the same few seconds over roofs and ground."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from companion.geometry.camera import Camera, Distortion
from companion.geometry.transforms import Pose, rotation_from_vector
from tests.support.flights.rendered_flight import CAMERA_DOWN, Flown, Terrain, fly

HEIGHT_M = 12.0
FISHEYE = (-0.02, 0.006, -0.003, 0.0006)
RADTAN = (-0.2834, 0.0740, 1.9e-4, 1.8e-5, 0.0)

NARROW = Camera(320, 240, 260.0, 258.0, 161.0, 118.0, body_from_camera=CAMERA_DOWN)
WIDEST = "fisheye with no ray in its corners"
CAMERAS = {
    "fisheye of 120 degrees": (
        Camera(320, 240, 150.0, 150.5, 159.0, 121.0, Distortion.EQUIDISTANT, FISHEYE, CAMERA_DOWN),
        10.0, 2.5,
    ),
    "752x480": (
        Camera(752, 480, 458.6, 457.3, 367.2, 248.4, Distortion.RADTAN, RADTAN, CAMERA_DOWN),
        20.0, 1.2,
    ),
    "1280x720": (
        Camera(1280, 720, 900.0, 902.0, 637.0, 363.0, Distortion.RADTAN,
               (-0.12, 0.03, 2e-4, 1e-4, 0.0), CAMERA_DOWN),
        15.0, 1.2,
    ),
    "10 frames/s": (NARROW, 10.0, 3.0),
    "60 frames/s": (NARROW, 60.0, 1.0),
    WIDEST: (
        Camera(320, 240, 103.0, 103.0, 159.0, 121.0, Distortion.EQUIDISTANT, FISHEYE, CAMERA_DOWN),
        10.0, 2.5,
    ),
}  # fmt: skip


def over_roofs(after_s: float) -> Pose:
    """Northwards at 3 m/s, rolling and pitching by 3 degrees and turning by 7 each second."""
    turn = np.array([0.06 * np.sin(1.3 * after_s), 0.05 * np.sin(1.7 * after_s), 0.12 * after_s])
    place = [3.0 * after_s - 5.0, 2.0 * np.sin(0.5 * after_s), -HEIGHT_M - np.sin(0.8 * after_s)]
    return Pose(rotation_from_vector(turn), np.array(place))


@lru_cache(maxsize=1)
def flown_with(name: str) -> Flown:
    """The flight; that of the last camera of all serves two tests."""
    camera, rate_hz, seconds = CAMERAS[name]
    return fly(camera, over_roofs, Terrain(3), seconds, rate_hz)


@pytest.mark.parametrize("name", CAMERAS)
def test_every_frame_is_tracked_to_decimetres(name: str) -> None:
    flown = flown_with(name)
    assert flown.placed_share == 1.0
    assert flown.errors().ate_sim3_m < 0.02 * HEIGHT_M
    assert not flown.warnings


def test_the_edge_of_a_wide_picture_is_looked_at() -> None:
    """Beyond the height of the picture its sides still show something, 80 degrees off the axis."""
    camera, flown = CAMERAS[WIDEST][0], flown_with(WIDEST)
    seen = np.concatenate([
        t.keypoints_px for t in flown.tracks if t.keypoints_px is not None
    ])  # fmt: skip
    off_axis = np.linalg.norm(camera.normalise(seen), axis=1)
    assert np.degrees(np.arctan(off_axis.max())) > 75.0
