"""A camera that was lost is found again in the part of the map where it should be by now."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from companion.config import TrackingConfig
from companion.geometry.transforms import Pose, Similarity, rotation_from_vector, yaw_rotation
from companion.slam.features.view import View
from companion.slam.tracking.frame_tracker import FrameTracker
from tests.support.reference.synthetic_map import CAMERA, GREY, Ground, flown, mapped

SAME = Similarity(1.0, np.eye(3), np.zeros(3))


def view_from(ground: Ground, world_from_camera: Pose) -> View:
    features, _ = ground.seen_from(world_from_camera)
    return View(
        0, 0, features, np.eye(3), GREY, world_from_camera.inverse(), np.full(len(features), -1)
    )


@pytest.mark.parametrize(("off_m", "found"), [(0.0, True), (0.9, True), (8.0, False)])
def test_it_is_found_over_ground_mapped_before_the_last_that_it_saw(
    off_m: float, found: bool
) -> None:
    """Up one lane and down the next; blind meanwhile, it comes back over the first lane."""
    ground = Ground(np.random.default_rng(2))
    lanes = [flown(np.array([-20.0 + 2.0 * k, -9.0])) for k in range(20)]
    lanes += [flown(np.array([20.0, -9.0 + 2.0 * k]), 0.1 * k) for k in range(14)]
    slam_map = mapped(ground, lanes, SAME)
    atlas: Any = SimpleNamespace(map=slam_map)
    tracker = FrameTracker(TrackingConfig(), CAMERA, atlas)

    last = view_from(ground, lanes[-1])
    assert tracker.match_around(last, lanes[-1].inverse(), 0)
    tracker.update_local_map(last)
    here = flown(np.array([-15.0, -9.0]), 0.05)
    guess = Pose(yaw_rotation(0.02) @ here.rotation, here.translation + [off_m, 0.0, 0.0]).inverse()
    view = view_from(ground, here)
    assert not tracker.match(view, guess, tracker.local, 60.0)
    assert tracker.match_around(view, guess, 0) is found
    if found:
        off = view.camera_from_map.inverse().translation - here.translation
        assert np.linalg.norm(off) < 0.05


def test_a_turn_that_nothing_predicts_is_seen_in_the_images() -> None:
    """Ten degrees from image to image, as in the hand, move them by 90 pixels."""
    ground = Ground(np.random.default_rng(3))
    slam_map = mapped(ground, [flown(np.array([0.5 * k, 0.0])) for k in range(8)], SAME)
    atlas: Any = SimpleNamespace(map=slam_map)
    tracker = FrameTracker(TrackingConfig(), CAMERA, atlas)
    last = view_from(ground, flown(np.array([1.0, 0.0])))
    assert tracker.match_around(last, last.camera_from_map, 0)
    tracker.update_local_map(last)
    here = flown(np.array([1.2, 0.0]))
    here = Pose(here.rotation @ rotation_from_vector(np.array([0.0, 0.17, 0.0])), here.translation)
    as_before = last.camera_from_map.rotation
    guess = Pose(as_before, -as_before @ here.translation)
    view = view_from(ground, here)
    assert not tracker.match(view, guess, tracker.local, 40.0, min_inliers=25)
    assert tracker.match_turned(view, guess, last, 25)
    assert np.linalg.norm(view.camera_from_map.inverse().translation - here.translation) < 0.05
