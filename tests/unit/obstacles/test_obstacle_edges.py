"""Edges in the world of what is told of obstacles."""

from __future__ import annotations

import numpy as np
import pytest

from companion.geometry.transforms import Pose, quaternion_from_euler, rotation_from_quaternion
from companion.obstacles.obstacle_edges import nothing_seen, seen_around
from companion.obstacles.obstacle_sectors import N_SECTORS, SECTOR_DEG, UNKNOWN_CM, Obstacles

HEADING_DEG = 30.0
BODY = Pose(
    rotation_from_quaternion(quaternion_from_euler(0.1, -0.05, np.radians(HEADING_DEG))),
    np.array([5.0, -2.0, -7.0]),
)
"""Leans, and looks to the north-north-east."""


def test_sectors_are_level_edges_by_the_heading_and_of_their_width() -> None:
    distances = np.full(N_SECTORS, UNKNOWN_CM, np.uint16)
    distances[4], distances[71] = 600, 2001
    seen = seen_around(9, Obstacles(3, distances, 30, 2000), BODY)
    assert seen.t_ns == 9
    ((left, right),) = seen.edges_world - BODY.translation
    bearing = np.radians(HEADING_DEG + 4 * SECTOR_DEG)
    middle = (left + right) / 2
    assert middle == pytest.approx([6 * np.cos(bearing), 6 * np.sin(bearing), 0.0], abs=1e-4)
    assert np.degrees(np.arctan2(right[1], right[0])) == pytest.approx(52.5, abs=1e-3)
    assert np.degrees(np.arctan2(left[1], left[0])) == pytest.approx(47.5, abs=1e-3)
    ((left, right),) = seen.free_world - BODY.translation
    assert np.linalg.norm((left + right) / 2) == pytest.approx(20.0, abs=1e-4)


def test_points_in_body_axes_are_turned_into_the_world() -> None:
    below_right = np.array([[2.0, 3.0, 1.5]])
    seen = seen_around(9, below_right, BODY)
    assert seen.edges_world.mean(1) == pytest.approx(BODY.apply(below_right), abs=1e-4)
    assert seen.edges_world[0, 0, 2] == seen.edges_world[0, 1, 2]
    assert len(seen.free_world) == 0


def test_nothing_has_no_edges() -> None:
    seen = nothing_seen(9)
    assert seen.edges_world.shape == seen.free_world.shape == (0, 2, 3)
