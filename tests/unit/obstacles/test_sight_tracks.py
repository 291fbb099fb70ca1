"""Corners that are followed from image to image."""

from __future__ import annotations

import numpy as np

from companion.geometry.camera import Camera
from companion.geometry.transforms import Pose
from companion.obstacles.sight_depth import sight_depth
from companion.obstacles.sight_tracks import SightTracks

AHEAD = Pose(np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.zeros(3))
CAMERA = Camera(320, 240, 250.0, 250.0, 159.5, 119.5, body_from_camera=AHEAD)


def test_a_cell_whose_corner_is_dropped_gets_another() -> None:
    rng = np.random.default_rng(4)
    grey = np.kron(rng.integers(40, 220, (30, 40)), np.ones((8, 8))).astype(np.uint8)
    tracks = SightTracks(CAMERA)
    tracks.step(grey, AHEAD.rotation, np.eye(3))
    n_corners = tracks.seen.shape[1]
    assert n_corners > 100

    tracks.drop(np.arange(n_corners) % 2 == 0)
    tracks.step(grey, AHEAD.rotation, np.eye(3))  # new ones are looked for in every other image
    assert tracks.seen.shape[1] == n_corners // 2
    tracks.step(grey, AHEAD.rotation, np.eye(3))
    assert tracks.seen.shape[1] == n_corners


def test_a_corner_that_slides_is_a_stray() -> None:
    """One of a hundred, 4 m and more ahead, is moved off its line by three pixels an image."""
    rng = np.random.default_rng(5)
    points = np.c_[rng.uniform(-2, 2, (100, 2)), rng.uniform(4, 12, 100)]
    eyes = [np.array([0.1 * n, 0.0, 0.0]) for n in range(6)]
    seen = np.stack([(points - eye)[:, :2] / points[:, 2:] for eye in eyes])
    seen[:, 7, 1] += 3.0 / 250.0 * np.arange(6)[::-1]
    depth = sight_depth(seen, [Pose(np.eye(3), eye) for eye in eyes], 250.0)
    assert np.flatnonzero(depth.stray).tolist() == [7]
    assert len(depth.rays) == 99
