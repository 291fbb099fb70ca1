"""Bookkeeping of the map: covisibility, nearest keyframes, recycling of removed points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from companion.geometry.transforms import Array, Pose, Similarity, angle_between
from companion.slam.compiled.observing import distinct
from companion.slam.features.patches import image_levels
from companion.slam.map.sparse_map import SlamMap
from companion.slam.mapping.mapper import Mapper
from companion.slam.mapping.mapping_worker import MapLock
from companion.slam.optimisation.pose_refinement import robust_cost, solve_sqpnp
from tests.support.reference.synthetic_map import CAMERA, GREY, Ground, flown, mapped


@pytest.fixture
def slam_map() -> SlamMap:
    ground = Ground(np.random.default_rng(9))
    path = [flown(p) for p in np.linspace((-15, 0), (15, 0), 25)]
    return mapped(ground, path, Similarity.identity())


def test_covisible_keyframes_are_found_with_counts(slam_map: SlamMap) -> None:
    _, points = slam_map.observations_of(slam_map.keyframes[12])
    exact = {
        key: len(np.intersect1d(points, slam_map.observations_of(k)[1]))
        for key, k in slam_map.keyframes.items()
    }
    found = slam_map.covisible(points, 15)
    assert found[0] == (len(points), 12)
    assert all(count == exact[key] for count, key in found)
    best = sorted(exact, key=lambda key: -exact[key])[:7]
    assert set(best) <= {key for _, key in found}


def test_nearest_keyframes_follow_moved_ones(slam_map: SlamMap) -> None:
    place = slam_map.keyframes[3].centre
    assert set(slam_map.nearest(place, 3, {3})) == {1, 2, 4} or set(
        slam_map.nearest(place, 3, {3})
    ) == {2, 4, 5}
    far = slam_map.keyframes[20]
    far.camera_from_map = slam_map.keyframes[3].camera_from_map
    slam_map.keyframes_moved()
    assert 20 in slam_map.nearest(place, 3, {3})


def test_nearest_keyframes_are_those_of_a_search_of_all(slam_map: SlamMap) -> None:
    random = np.random.default_rng(2)

    def searched(place: Array, n: int, exclude: set[int]) -> list[int]:
        apart = {k: np.linalg.norm(f.centre - place) for k, f in slam_map.keyframes.items()}
        return [k for k in sorted(apart, key=lambda k: apart[k]) if k not in exclude][:n]

    for turn in range(80):
        keys = list(slam_map.keyframes)
        key = keys[random.integers(len(keys))]
        changed: list[int] | None = [key]
        if turn % 3 == 0:
            pose = slam_map.keyframes[key].camera_from_map
            slam_map.keyframes[key].camera_from_map = Pose(
                pose.rotation, pose.translation + random.normal(size=3)
            )
        elif turn % 7 == 1:
            del slam_map.keyframes[key]
        elif turn % 7 == 2:
            changed = [100 + turn]
            slam_map.keyframes[100 + turn] = replace(
                slam_map.keyframes[key], keyframe_id=100 + turn
            )
        elif turn % 7 == 5:  # as when maps are merged, not in order
            slam_map.keyframes[key] = slam_map.keyframes.pop(key)
            changed = None
        slam_map.keyframes_moved(changed)
        place = random.normal(scale=10.0, size=3)
        exclude = set(random.choice(keys, 3).tolist())
        for n in (1, 4, len(keys)):
            assert slam_map.nearest(place, n, exclude) == searched(place, n, exclude)
        centres = [f.centre for k, f in slam_map.keyframes.items() if 3 <= k <= 17]
        np.testing.assert_array_equal(slam_map.centres(3, 17), centres)
        poses = slam_map.poses()
        assert list(poses) == list(slam_map.keyframes)
        for key, pose in poses.items():
            there = slam_map.keyframes[key].camera_from_map.inverse()
            np.testing.assert_allclose(pose.matrix(), there.matrix(), atol=1e-12)


def test_patch_rows_of_removed_points_are_reused(slam_map: SlamMap) -> None:
    keyframe = slam_map.keyframes[0]
    size = len(slam_map.patches.near)
    levels = image_levels(GREY)
    features = np.arange(len(keyframe.features))
    positions: Array = np.zeros((len(features), 3))
    for _ in range(60):
        ids = slam_map.add_points(
            positions, keyframe.keyframe_id, keyframe.features, features, levels
        )
        assert (slam_map.patches_of(ids).grey == 128).all()
        slam_map.alive[ids] = False
        slam_map.free_patches()
        assert (slam_map.patch_at[ids] == -1).all()
    assert len(slam_map.patches.near) == size


def test_planar_pose_is_found_without_initial_guess() -> None:
    rng = np.random.default_rng(10)
    camera = flown(np.array([1.0, -2.0]), yaw_rad=0.4).inverse()
    points: Array = np.c_[rng.uniform(-4, 4, (100, 2)), np.zeros(100)]
    p = camera.apply(points)
    seen = p[:, :2] / p[:, 2:] + rng.normal(scale=5e-4, size=(100, 2))
    found = solve_sqpnp(points, seen)
    assert found is not None
    assert angle_between(found.rotation, camera.rotation) < 0.005
    assert found.translation == pytest.approx(camera.translation, abs=0.05)
    whitening = np.repeat(np.eye(2)[None] / 5e-4, 100, 0)
    assert robust_cost(found, points, seen, whitening) < 130
    assert solve_sqpnp(points[:5], seen[:5]) is None


def test_long_flight_is_adjusted_in_windows(
    slam_map: SlamMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("companion.slam.mapping.map_adjustment.MAX_VARIABLE", 10)
    rng = np.random.default_rng(11)
    for k in list(slam_map.keyframes.values())[2:]:
        pose = k.camera_from_map
        k.camera_from_map = Pose(pose.rotation, pose.translation + rng.normal(scale=0.05, size=3))

    def error_px() -> float:
        errors = []
        for k in slam_map.keyframes.values():
            features, points = slam_map.observations_of(k)
            seen = CAMERA.project(k.camera_from_map.apply(slam_map.positions[points]))
            errors.append(np.linalg.norm(seen - k.features.pixels[features], axis=1))
        return float(np.median(np.concatenate(errors)))

    assert error_px() > 2.0
    Mapper(CAMERA, slam_map, MapLock()).adjust_all(4)
    assert error_px() < 0.6


def test_one_observation_moves_as_several_do(slam_map: SlamMap) -> None:
    keyframe = slam_map.keyframes[4]
    features, points = slam_map.observations_of(keyframe)
    feature, dropped = int(features[0]), int(points[0])
    kept = next(p for p in range(slam_map.n_points) if p not in points)
    names = ("observers", "n_observers")
    before = {name: getattr(slam_map, name).copy() for name in names}
    slam_map.move_observation(keyframe, feature, kept)
    moved = {name: getattr(slam_map, name).copy() for name in names}
    assert keyframe.point_ids[feature] == kept
    for name, values in before.items():
        setattr(slam_map, name, values)
    keyframe.point_ids[feature] = dropped
    slam_map.add_observations(keyframe, np.array([feature]), np.array([kept]))
    for name, values in moved.items():
        np.testing.assert_array_equal(getattr(slam_map, name), values)


def test_dead_points_are_not_observed(slam_map: SlamMap) -> None:
    keyframe = slam_map.keyframes[7]
    keyframe.point_ids[::3] = -1
    slam_map.alive[keyframe.point_ids[1::6]] = False
    ids = keyframe.point_ids
    features = np.flatnonzero((ids >= 0) & slam_map.alive[np.maximum(ids, 0)])
    found, points = slam_map.observations_of(keyframe)
    assert 0 < len(features) < np.count_nonzero(ids >= 0)
    np.testing.assert_array_equal(found, features)
    np.testing.assert_array_equal(points, ids[features])


def test_local_points_are_each_of_the_living_ones_that_keyframes_observe(
    slam_map: SlamMap,
) -> None:
    near = list(slam_map.keyframes.values())
    near[1].point_ids[::3] = -1
    slam_map.alive[near[2].point_ids[1::6]] = False
    ids = np.concatenate([each.point_ids for each in near])
    expected = np.unique(ids[(ids >= 0) & slam_map.alive[np.maximum(ids, 0)]])
    assert 0 < len(expected) < len(ids)
    np.testing.assert_array_equal(distinct(ids, slam_map.alive), expected)
    assert len(distinct(np.full(4, -1), slam_map.alive)) == 0
