"""A pole before a far wall is seen in the newest image."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose, Similarity, rotation_from_vector
from companion.messages import Track, TrackState
from companion.obstacles.newest_sight import NewestSight, Seen, things_in
from companion.obstacles.obstacle_finder import ObstacleFinder, Round
from tests.support.flights.approach_scene import ApproachScene, Rod, Sheet

AHEAD = Pose(np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.zeros(3))
CAMERA = Camera(320, 240, 250.0, 250.0, 159.5, 119.5, body_from_camera=AHEAD)
SCENE = ApproachScene([
    Sheet(np.array([-60.0, -60, 0]), np.array([120.0, 0, 0]), np.array([0, 120.0, 0]), 1),
    Sheet(np.array([30.0, -40, -22]), np.array([0, 80.0, 0]), np.array([0, 0, 22.0]), 2),
    Rod(np.array([6.0, 0.8, 0]), np.array([6.0, 0.8, -7]), 0.15, 4),
], 0.06)  # fmt: skip
POLE_M = np.hypot(6.0, 0.8)


def looked(
    path: Callable[[int], Array],
    pose_error_m: float = 0.0,
    camera: Camera = CAMERA,
    scene: ApproachScene = SCENE,
    each: Callable[[Seen], None] = lambda seen: None,
    n_images: int = 12,
) -> Seen | None:
    """After so many images; the poses told are off by so much across the way, and turned."""
    rng = np.random.default_rng(3)
    sight = NewestSight(camera)
    update: Any = SimpleNamespace(
        georeference=SimpleNamespace(world_from_map=Similarity.identity()),
        place_of=lambda _: Similarity.identity(),
    )
    for n in range(n_images):
        pose = Pose(np.eye(3), path(n)) @ AHEAD
        off = Pose(
            rotation_from_vector(rng.normal(0, 1e-3, 3)),
            rng.normal(0, pose_error_m, 3) * [0.3, 1, 1],
        )
        told = pose @ off if pose_error_m else pose
        track = Track(n, n, TrackState.TRACKING, told, 1, told)
        sight.add(track, scene.picture(camera, pose), update)
        if sight.newest is not None:
            each(sight.newest)
    return sight.newest


def on_the_pole(seen: Seen) -> Array:
    """Distances of the things within four degrees of it."""
    away = things_in(seen, 0.0) - seen.eye_world_m
    bearing = np.arctan2(away[:, 1], away[:, 0]) - np.arctan2(0.8 - seen.eye_world_m[1], 6.0)
    level = np.hypot(away[:, 0], away[:, 1])
    return np.asarray(level[(np.abs(bearing) < np.radians(4)) & (np.abs(away[:, 2]) < 0.9)])


@pytest.mark.parametrize("pose_error_m", [0.0, 0.02])
def test_a_pole_is_seen_by_poses_that_are_centimetres_off(pose_error_m: float) -> None:
    seen = looked(lambda n: np.array([0.0, 0.05 * n - 0.55, -3.0]), pose_error_m)
    assert seen is not None
    near = np.sort(on_the_pole(seen))
    near = near[near < 12.0]
    assert len(near) >= 6
    assert near[2] == pytest.approx(POLE_M, abs=0.05 * POLE_M + 0.1)
    assert np.median(near) == pytest.approx(POLE_M, rel=0.05)


def test_without_a_way_nothing_is_known() -> None:
    seen = looked(lambda n: np.array([0.0, 0.0, -3.0]))
    assert seen is not None
    assert len(seen.points_world_m) == 0


def test_what_is_seen_goes_with_a_correction_of_the_map() -> None:
    finder = ObstacleFinder(CAMERA)

    def points_in_view(n: int, shift_m: Array) -> Array:
        pose = Pose(np.eye(3), np.array([0.0, 0.05 * n - 0.55, -3.0])) @ AHEAD
        grey = SCENE.picture(CAMERA, pose)
        track = Track(n, n, TrackState.TRACKING, pose, 1, pose)
        world_from_map = Similarity(1.0, np.eye(3), shift_m)
        update: Any = SimpleNamespace(
            georeference=SimpleNamespace(world_from_map=world_from_map),
            place_of=lambda _: Similarity.identity(),
        )
        found = finder.look(Round(n, track, (), update, grey, (), n), (), None)
        assert isinstance(found, np.ndarray)
        return found

    for n in range(12):
        before = points_in_view(n, np.zeros(3))
    assert len(before)
    assert np.allclose(before[:, :2], [6.0, 0.8], atol=0.3), "the pole"
    # of the same image, which is looked at once
    assert points_in_view(11, np.array([0.0, 4.0, 0.0])) == pytest.approx(before, abs=1e-6)
