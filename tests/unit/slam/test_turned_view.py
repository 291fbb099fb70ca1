"""Turns on the spot: new ground without parallax."""

from __future__ import annotations

import numpy as np
import pytest

from companion.geometry.camera import Camera
from companion.geometry.transforms import Pose, rotation_from_vector, yaw_rotation
from companion.messages import TrackState
from companion.slam.mapping.turned_view import MIN_KNOWN, on_level_ground
from tests.support.flights.rendered_flight import CAMERA_DOWN, Terrain, fly

FORWARD_DOWN = rotation_from_vector(np.array([0.0, np.pi / 4, 0.0])) @ CAMERA_DOWN.rotation
CAMERA = Camera(
    320, 240, 260.0, 260.0, 159.5, 119.5, body_from_camera=Pose(FORWARD_DOWN, np.zeros(3))
)
HEIGHT_M, SPEED_M_S, FORWARD_S, TURN_S = 8.0, 1.5, 4.0, 12.0
SWAY_M = 0.08


def about(t_s: float) -> Pose:
    """Forward, then once about on the spot, with some sway, and a moment there."""
    there = min(t_s, FORWARD_S) * SPEED_M_S
    turned = np.clip((t_s - FORWARD_S - 1.0) / TURN_S, 0.0, 1.0) * 2.0 * np.pi
    sway = SWAY_M * np.array([np.sin(1.1 * t_s), np.sin(0.7 * t_s + 1.0), 0.5 * np.sin(0.9 * t_s)])
    return Pose(yaw_rotation(float(turned)), np.array([there, 0.0, -HEIGHT_M]) + sway)


def test_a_turn_on_the_spot_is_tracked_all_the_way() -> None:
    flown = fly(CAMERA, about, Terrain(3), FORWARD_S + TURN_S + 3.0, 10.0)
    states = [track.state for track in flown.tracks if not track.backfilled]
    began = states.index(TrackState.TRACKING)
    assert began < 30
    assert set(states[began:]) == {TrackState.TRACKING}
    assert flown.live_errors().ate_sim3_m < 0.15


LEVEL_DOWN = rotation_from_vector(np.radians([12.0, 0.0, -7.0])) @ np.array([0.0, 0.6, 0.8])
"""In the axes of a camera that rolls and looks half down."""


def ground(n: int, relief_m: float) -> np.ndarray:
    """Points (N, 3) 5 m below the camera, but for their relief."""
    rng = np.random.default_rng(1)
    level = np.linalg.svd(LEVEL_DOWN[None])[2][1:]
    depth_m = 5.0 + relief_m * rng.uniform(-1, 1, n)
    return np.asarray(rng.uniform(-4, 4, (n, 2)) @ level + np.outer(depth_m, LEVEL_DOWN))


@pytest.mark.parametrize("relief_m", [0.0, 0.3])
def test_features_lie_on_the_level_of_the_points_known(relief_m: float) -> None:
    normalised = np.array([[0.3, 0.2], [-0.4, 0.1], [0.0, -3.0], [0.1, -1.4]])
    seen, points = on_level_ground(ground(200, relief_m), LEVEL_DOWN, normalised)
    assert seen.tolist() == [0, 1]  # of the others one is above the horizon, one just below it
    np.testing.assert_allclose(points @ LEVEL_DOWN, 5.0, atol=0.1)
    np.testing.assert_allclose(points[:, :2] / points[:, 2:], normalised[:2])


@pytest.mark.parametrize(("n", "relief_m"), [(MIN_KNOWN - 1, 0.3), (200, 3.0)])
def test_nothing_is_placed_where_no_level_is_known(n: int, relief_m: float) -> None:
    seen, points = on_level_ground(ground(n, relief_m), LEVEL_DOWN, np.array([[0.3, 0.2]]))
    assert len(seen) == len(points) == 0


def test_nothing_is_placed_on_ground_above_the_camera() -> None:
    seen, _ = on_level_ground(-ground(200, 0.3), LEVEL_DOWN, np.array([[0.3, 0.2]]))
    assert len(seen) == 0
