"""Keyframe decision: none on return passes, new ones over new ground."""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Pose, Similarity
from companion.slam.features.orb_features import Ints
from companion.slam.features.view import View
from companion.slam.map.sparse_map import SlamMap
from companion.slam.tracking.keyframe_choice import (
    FEW_POINTS,
    N_NEWEST_EXCLUDED,
    equivalent_keyframe,
    needs_keyframe,
)
from tests.support.reference.synthetic_map import GREY, Ground, flown, mapped

THERE = [flown(np.array([x, 0.0])) for x in np.linspace(-12, 12, 49)]


def view_from(ground: Ground, slam_map: SlamMap, place: Pose, share: float = 1.0) -> View:
    """A view tracked by `share` of the points that keyframes of the map observe of it."""
    features, index = ground.seen_from(place)
    known: dict[int, int] = {}
    for keyframe in slam_map.keyframes.values():
        _, points = slam_map.observations_of(keyframe)
        for point in points.tolist():
            at = slam_map.positions[point]
            known[hash(tuple(np.round(at, 6)))] = point
    keys = [hash(tuple(np.round(ground.points[i], 6))) for i in index.tolist()]
    ids: Ints = np.array([known.get(key, -1) for key in keys])
    ids[int(share * len(ids)) :] = -1
    seen = View(99, 99 * 10**9, features, None, GREY, place.inverse(), ids)
    return seen


def test_return_pass_reuses_an_older_keyframe() -> None:
    ground = Ground(np.random.default_rng(11))
    slam_map = mapped(ground, THERE, Similarity.identity())
    newest = slam_map.keyframes[max(slam_map.keyframes)]
    again = view_from(ground, slam_map, flown(np.array([-5.1, 0.1])))
    assert needs_keyframe(slam_map, newest, again, again.t_ns)
    cover = equivalent_keyframe(slam_map, again)
    assert cover is not None
    assert np.linalg.norm(cover.centre - flown(np.array([-5.1, 0.1])).translation) < 0.5
    assert not needs_keyframe(slam_map, cover, again, again.t_ns)


def test_newest_and_weakly_tracked_keyframes_are_not_reused() -> None:
    ground = Ground(np.random.default_rng(12))
    slam_map = mapped(ground, THERE, Similarity.identity())
    newest = list(slam_map.keyframes.values())[-N_NEWEST_EXCLUDED:]
    ahead = view_from(ground, slam_map, newest[-1].camera_from_map.inverse())
    assert equivalent_keyframe(slam_map, ahead) is None
    weak = view_from(ground, slam_map, flown(np.array([-5.1, 0.1])), share=0.4)
    assert equivalent_keyframe(slam_map, weak) is None
    aside = view_from(ground, slam_map, flown(np.array([-5.1, 1.5])))
    assert equivalent_keyframe(slam_map, aside) is None


def test_without_attitude_a_map_of_few_points_grows_sooner() -> None:
    ground = Ground(np.random.default_rng(13), n=400)
    slam_map = mapped(ground, THERE, Similarity.identity())
    reference = slam_map.keyframes[24]
    place = flown(np.array([0.15, 0.0]))
    few = view_from(ground, slam_map, place)
    assert len(few.features) * 0.75 < few.n_inliers < FEW_POINTS
    assert needs_keyframe(slam_map, reference, few, few.t_ns)
    few.ned_from_camera = np.eye(3)
    assert not needs_keyframe(slam_map, reference, few, few.t_ns)
