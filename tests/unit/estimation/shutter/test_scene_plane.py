"""The plane before the camera, among points that are not on it."""

from __future__ import annotations

import numpy as np

from companion.estimation.shutter.shutter_of_frames import scene_plane
from companion.geometry.transforms import rotation_from_vector


def test_ground_with_some_houses() -> None:
    rng = np.random.default_rng(4)
    n = 200
    level = np.c_[rng.uniform(-8, 8, (n, 2)), np.full(n, 12.0)]
    level[: n // 5, 2] -= rng.uniform(1, 4, n // 5)
    turn = rotation_from_vector(np.array([0.4, -0.2, 0.1]))
    down = turn @ np.array([0.0, 0.0, 1.0])
    plane = scene_plane(level @ turn.T)
    assert plane is not None
    np.testing.assert_allclose(plane, down / 12.0, atol=0.1 / 12.0)


def test_too_few_points_give_none() -> None:
    assert scene_plane(np.tile([0.0, 0.0, 5.0], (29, 1))) is None
    assert scene_plane(np.tile([0.0, 0.0, -5.0], (99, 1))) is None
