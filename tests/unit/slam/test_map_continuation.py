"""Continuation of a map by a two-view reconstruction from its last tracked frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from companion.geometry.transforms import Pose, Similarity, angle_between
from companion.slam.features.view import View
from companion.slam.initialisation.bootstrap import TwoViewReconstruction
from companion.slam.initialisation.map_continuation import MIN_SHARED, continuation_of
from companion.slam.map.sparse_map import SlamMap
from tests.support.reference.synthetic_map import GREY, Ground, flown, mapped

UNIT = 0.3
"""Of the start, in metres of the map."""


def both() -> tuple[SlamMap, View, TwoViewReconstruction, Pose]:
    """A map, its last tracked view, a reconstruction from it in a frame of its own, and the true
    pose."""
    ground = Ground(np.random.default_rng(9))
    path = [flown(np.array([x, 0.0])) for x in np.linspace(-4, 0, 5)]
    slam_map = mapped(ground, path, Similarity.identity())
    last = slam_map.keyframes[4]
    tracked = View(
        4, last.t_ns, last.features, None, GREY, last.camera_from_map, last.point_ids.copy()
    )
    second_from_map = flown(np.array([1.0, 0.3]), 0.2).inverse()
    features, index = ground.seen_from(second_from_map.inverse())
    places = slam_map.positions[last.point_ids]
    index_first = np.linalg.norm(places[:, None] - ground.points, axis=2).argmin(1)
    _, in_first, in_second = np.intersect1d(index_first, index, return_indices=True)
    points = last.camera_from_map.apply(ground.points[index_first[in_first]]) / UNIT
    second_from_first = second_from_map @ last.camera_from_map.inverse()
    start = TwoViewReconstruction(
        replace(tracked, camera_from_map=Pose.identity()),
        View(
            5, 1, features, None, GREY,
            Pose(second_from_first.rotation, second_from_first.translation / UNIT),
            np.full(len(features), -1),
        ),
        points, in_first, in_second,
    )  # fmt: skip
    return slam_map, tracked, start, second_from_map


def test_reconstruction_is_placed_at_the_scale_and_pose_of_the_map() -> None:
    slam_map, tracked, start, second_from_map = both()
    forgotten = start.features_first[30:]
    true = slam_map.positions[tracked.point_ids[forgotten]]
    tracked.point_ids[forgotten] = -1
    found = continuation_of(slam_map, tracked, start)
    assert found is not None
    assert int(found.known.sum()) == 30
    assert (found.features_first == forgotten).all()
    assert found.points_map == pytest.approx(true, abs=1e-6)
    assert found.second_from_map.translation == pytest.approx(second_from_map.translation, abs=1e-6)
    assert angle_between(found.second_from_map.rotation, second_from_map.rotation) < 1e-6


def test_too_few_shared_points_or_inconsistent_depths_are_rejected() -> None:
    slam_map, tracked, start, _ = both()
    ids = tracked.point_ids[start.features_first].copy()
    tracked.point_ids[start.features_first[MIN_SHARED - 1 :]] = -1
    assert continuation_of(slam_map, tracked, start) is None
    tracked.point_ids[start.features_first] = ids
    scatter = np.random.default_rng(2).uniform(0.3, 3.0, (len(start.points_map), 1))
    wrong = TwoViewReconstruction(
        start.first, start.second, start.points_map * scatter, start.features_first,
        start.features_second,
    )  # fmt: skip
    assert continuation_of(slam_map, tracked, wrong) is None


def test_reconstruction_from_another_view_is_rejected() -> None:
    slam_map, tracked, start, _ = both()
    tracked.seq = 3
    assert continuation_of(slam_map, tracked, start) is None
