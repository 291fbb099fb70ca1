"""Frames of a young map, whose scale was wrong, once its points have been adjusted."""

from __future__ import annotations

import numpy as np
import pytest

from companion.geometry.transforms import Pose, Similarity
from companion.messages import TrackRefined
from companion.slam.features.view import View
from companion.slam.map.sparse_map import SlamMap
from companion.slam.mapping.mapper import WINDOW
from companion.slam.tracking.refined_frames import MOST_WAITING, RefinedFrames
from tests.support.reference.synthetic_map import GREY, Ground, flown, mapped

STRETCH = 1.16
FRAME = flown(np.array([1.5, 0.4]))
SEQ, T_NS = 77, 1_234_567_890


@pytest.fixture
def ground() -> Ground:
    return Ground(np.random.default_rng(4))


def young(ground: Ground) -> tuple[SlamMap, View]:
    """A map of two keyframes, too large about the second, and a frame tracked in it."""
    slam_map = mapped(
        ground, [flown(np.array([x, 0.0])) for x in (0.0, 1.0)], Similarity.identity()
    )
    here = slam_map.keyframes[1].camera_from_map.inverse().translation
    n = slam_map.n_points
    slam_map.positions[:n] = here + STRETCH * (slam_map.positions[:n] - here)
    features, index = ground.seen_from(FRAME)
    point_of = {
        tuple(np.round((slam_map.positions[i] - here) / STRETCH + here, 6)): i for i in range(n)
    }
    ids = [point_of.get(tuple(np.round(ground.points[i], 6)), -1) for i in index.tolist()]
    as_tracked = Pose(FRAME.rotation, here + STRETCH * (FRAME.translation - here))
    view = View(SEQ, T_NS, features, None, GREY, as_tracked.inverse(), np.array(ids))
    return slam_map, view


def adjusted(slam_map: SlamMap) -> None:
    here = slam_map.keyframes[1].camera_from_map.inverse().translation
    n = slam_map.n_points
    slam_map.positions[:n] = here + (slam_map.positions[:n] - here) / STRETCH


def off_m(slam_map: SlamMap, refined: TrackRefined) -> float:
    keyframe = slam_map.keyframes[refined.keyframe_id]
    pose = keyframe.camera_from_map.inverse() @ refined.keyframe_from_camera
    return float(np.linalg.norm(pose.translation - FRAME.translation))


def test_a_frame_follows_its_points_once_local_adjustment_has_passed_it(ground: Ground) -> None:
    slam_map, view = young(ground)
    frames = RefinedFrames()
    frames.add(slam_map, view, slam_map.keyframes[1])
    adjusted(slam_map)
    assert list(frames.due(1 + WINDOW, [slam_map])) == []
    (refined,) = frames.due(2 + WINDOW, [slam_map])
    assert (refined.seq, refined.t_ns, refined.keyframe_id) == (SEQ, T_NS, 1)
    assert np.linalg.norm(FRAME.translation - view.centre) > 0.08
    assert off_m(slam_map, refined) < 0.01
    assert list(frames.due(99, [slam_map])) == []


def test_lengths_are_in_the_unit_that_its_keyframe_began_with(ground: Ground) -> None:
    slam_map, view = young(ground)
    frames = RefinedFrames()
    frames.add(slam_map, view, slam_map.keyframes[1])
    adjusted(slam_map)
    slam_map.unit_of[1] = 2.0
    n = slam_map.n_points
    slam_map.positions[:n] *= 2.0
    for keyframe in slam_map.keyframes.values():
        pose = keyframe.camera_from_map.inverse()
        keyframe.camera_from_map = Pose(pose.rotation, 2.0 * pose.translation).inverse()
    (refined,) = frames.rest([slam_map])
    step = flown(np.array([1.0, 0.0])).inverse() @ FRAME
    assert np.allclose(refined.keyframe_from_camera.translation, step.translation, atol=0.01)


def test_a_frame_keeps_its_pose_where_little_is_left_of_what_it_saw(ground: Ground) -> None:
    slam_map, view = young(ground)
    frames = RefinedFrames()
    for _ in range(4):
        frames.add(slam_map, view, slam_map.keyframes[1])
    assert list(frames.due(99, [])) == [], "its map has become a part of another"
    seen = view.point_ids[view.point_ids >= 0]
    frames.add(slam_map, view, slam_map.keyframes[1])
    slam_map.alive[seen[20:]] = False
    assert list(frames.rest([slam_map])) == []
    slam_map.alive[seen[20:]] = True
    frames.add(slam_map, view, slam_map.keyframes[1])
    slam_map.born[seen[20:]] += 1  # their ids are those of other points now
    assert list(frames.rest([slam_map])) == []
    frames.add(slam_map, view, slam_map.keyframes.pop(1))
    assert list(frames.rest([slam_map])) == []


def test_a_keyframe_and_a_frame_that_sees_little_do_not_wait(ground: Ground) -> None:
    slam_map, view = young(ground)
    frames = RefinedFrames()
    view.t_ns = slam_map.keyframes[1].t_ns
    frames.add(slam_map, view, slam_map.keyframes[1])
    view.t_ns, view.point_ids = T_NS, np.where(np.arange(len(view.point_ids)) < 20, 5, -1)
    frames.add(slam_map, view, slam_map.keyframes[1])
    assert list(frames.rest([slam_map])) == []


def test_over_one_spot_frames_do_not_gather_without_end(ground: Ground) -> None:
    slam_map, view = young(ground)
    frames = RefinedFrames()
    n_given = 0
    for _ in range(MOST_WAITING + 5):
        frames.add(slam_map, view, slam_map.keyframes[1])
        n_given += len(list(frames.due(2, [slam_map])))
    assert n_given == 5
    assert len(list(frames.rest([slam_map]))) == MOST_WAITING
