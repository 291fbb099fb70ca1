"""Obstacles in the space around turned and tilted vehicles, above ground, and cells unconfirmed."""

from __future__ import annotations

import numpy as np
import pytest

from companion.geometry.transforms import (
    Array,
    Pose,
    quaternion_from_euler,
    rotation_from_quaternion,
)
from companion.obstacles.obstacle_space import N_CELLS, cells_of, cells_with, nearest_in_cells

PLACE = np.array([103.0, -57.0, -12.0])
EVERYWHERE = np.ones(N_CELLS, bool)


def vehicle(yaw_deg: float, pitch_deg: float = 0.0, roll_deg: float = 0.0) -> Pose:
    q = quaternion_from_euler(*np.radians([roll_deg, pitch_deg, yaw_deg]))
    return Pose(rotation_from_quaternion(q), PLACE)


def at(north_m: float, east_m: float, down_m: float, n: int = 6) -> Array:
    """A small cluster about a place relative to the vehicle."""
    out: Array = PLACE + [north_m, east_m, down_m] + np.linspace(-0.02, 0.02, n)[:, None]
    return out


def ground(down_m: float, rise: float = 0.0) -> Array:
    """Ground below the vehicle, which rises northwards."""
    north, east = np.meshgrid(np.arange(-15.0, 15.0, 0.25), np.arange(-15.0, 15.0, 0.25))
    down = down_m - rise * north
    out: Array = PLACE + np.stack([north.ravel(), east.ravel(), down.ravel()], 1)
    return out


def test_a_place_comes_back_in_body_axes() -> None:
    pose = vehicle(70, 12, -8)
    found = nearest_in_cells(pose, at(4.0, -3.0, -2.0), EVERYWHERE)
    assert found == pytest.approx(pose.rotation.T @ [4.0, -3.0, -2.0] * np.ones((1, 3)), abs=0.03)


def test_the_nearest_of_each_cell_counts_but_for_outliers() -> None:
    points = np.concatenate([at(9, 0, 0), at(6, 0, 0), at(3, 0, 0, n=2), at(0, 7, -5)])
    found = nearest_in_cells(vehicle(0), points, EVERYWHERE)
    assert sorted(np.round(np.linalg.norm(found, axis=1), 1)) == [6.0, 8.6]


def test_ground_is_no_obstacle_and_what_stands_on_it_is() -> None:
    flat = ground(5.0)
    assert len(nearest_in_cells(vehicle(0), flat, EVERYWHERE)) == 0
    assert len(nearest_in_cells(vehicle(0), ground(5.0, rise=0.15), EVERYWHERE)) == 0
    tree = np.concatenate([at(3.0, 0.5, down) for down in np.arange(2.0, 5.0, 0.2)])
    found = nearest_in_cells(vehicle(0), np.concatenate([flat, tree]), EVERYWHERE)
    assert found[:, 2].min() == pytest.approx(2.0, abs=0.3)
    assert (np.abs(found[:, 0] - 3.0) < 0.1).all()


def test_what_hangs_below_without_ground_is_told_at_the_height_of_the_vehicle() -> None:
    assert len(nearest_in_cells(vehicle(0), at(4, 0, 0.5), EVERYWHERE)) == 1


def test_a_cell_that_no_image_confirms_tells_nothing() -> None:
    pose, ahead = vehicle(40), at(5, 5, 0)
    is_seen = cells_with((ahead - PLACE) * 3.0, pose)
    assert is_seen.sum() == 1
    assert len(nearest_in_cells(pose, np.concatenate([ahead, at(-5, 5, 0)]), is_seen)) == 1
    assert not cells_with((ahead - PLACE)[:2], pose).any()


def test_steep_rays_belong_to_no_cell() -> None:
    cells = cells_of(np.array([[0.1, 0, 5.0], [0.1, 0, -5.0], [1.0, 0, 0]]), vehicle(0))
    assert (cells[:2] == -1).all() and cells[2] >= 0
