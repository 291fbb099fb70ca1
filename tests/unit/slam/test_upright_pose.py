"""Absolute pose with known gravity and half of the matches outliers."""

from __future__ import annotations

import numpy as np
import pytest

from companion.geometry.transforms import Array, quaternion_from_euler, rotation_from_quaternion
from companion.slam.optimisation.upright_pose import upright_pose


def scene(seed: int, pitch: float) -> tuple[Array, Array, Array, Array, Array]:
    """Points, their observations, the level frame, and the true camera_from_map."""
    rng = np.random.default_rng(seed)
    heading = rng.uniform(-np.pi, np.pi)
    map_from_level = rotation_from_quaternion(quaternion_from_euler(0, 0, heading))
    tilt = rotation_from_quaternion(quaternion_from_euler(rng.uniform(-0.4, 0.4), pitch, 0))
    level_from_camera = tilt @ np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    rotation = (map_from_level @ level_from_camera).T
    translation = rng.normal(size=3)
    normalised = rng.uniform(-0.6, 0.6, (60, 2))
    in_camera = np.c_[normalised, np.ones(60)] * rng.uniform(3, 30, (60, 1))
    points = (in_camera - translation) @ rotation
    normalised[30:] += rng.uniform(0.1, 0.5, (30, 2))
    return points, normalised, level_from_camera, rotation, translation


@pytest.mark.parametrize("pitch", [-1.5, -0.8, 0.0])
@pytest.mark.parametrize("seed", range(5))
def test_two_points_are_enough(seed: int, pitch: float) -> None:
    points, normalised, level_from_camera, rotation, translation = scene(seed, pitch)
    found = upright_pose(points, normalised, level_from_camera, 1e-6, seed)
    assert found is not None
    pose, agree = found
    assert agree.tolist() == [True] * 30 + [False] * 30
    assert np.abs(pose.rotation - rotation).max() < 1e-7
    assert np.abs(pose.translation - translation).max() < 1e-6


def test_degenerate_points_give_no_pose() -> None:
    """One point; the same twice; two at eye level, whose heights carry no information."""
    level = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    point, seen = np.array([[1.0, 2.0, 3.0]]), np.array([[0.1, 0.2]])
    assert upright_pose(point, seen, level, 0.01, 0) is None
    both = np.repeat(seen, 2, 0)
    assert upright_pose(np.repeat(point, 2, 0), both, level, 0.01, 0) is None
    apart = np.array([[5.0, 1.0, 0.0], [7.0, -2.0, 0.0]])
    assert upright_pose(apart, np.array([[0.1, 0.0], [-0.2, 0.0]]), level, 0.01, 0) is None
