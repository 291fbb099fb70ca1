"""Third-view consistency check of true and false reconstructions."""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Array, Pose
from companion.slam.features.orb_features import Ints
from companion.slam.features.view import View
from companion.slam.initialisation.third_view import middle_view, third_view_rejects
from tests.support.reference.synthetic_map import GREY, Ground, flown

STEP_NS = 100_000_000


def three(middle: Pose) -> tuple[list[View], Array, Ints]:
    """Views from 0, m and 2 m to the north, the points of the first, and its features."""
    ground = Ground(np.random.default_rng(4))
    views: list[View] = []
    index_first = np.zeros(0, np.int64)
    for k, pose in enumerate([flown(np.array([0.0, 0.0])), middle, flown(np.array([2.0, 0.0]))]):
        features, index = ground.seen_from(pose)
        if k == 0:
            index_first = index.astype(np.int64)
        unknown = np.full(len(features), -1)
        views.append(View(k, k * STEP_NS, features, None, GREY, pose.inverse(), unknown))
    return views, ground.points[index_first], np.arange(len(index_first))


def test_true_reconstruction_passes_though_the_camera_rotated() -> None:
    (first, third, second), points, features = three(flown(np.array([1.2, 0.4]), 0.1))
    assert not third_view_rejects(third, first, second, points, features)


def test_depth_inverted_reconstruction_is_rejected() -> None:
    (first, third, second), points, features = three(flown(np.array([1.2, 0.4]), 0.1))
    in_first = first.camera_from_map.apply(points)
    depth = in_first[:, 2:]
    wrong = in_first * (9.0 - 3.0 * (depth - 9.0)) / depth  # on the same rays
    wrong_map = first.camera_from_map.inverse().apply(wrong)
    assert third_view_rejects(third, first, second, wrong_map, features)


def test_view_without_overlap_does_not_reject() -> None:
    (first, third, second), points, features = three(flown(np.array([25.0, 25.0])))
    assert not third_view_rejects(third, first, second, points[::-1], features)


def test_middle_view_is_chosen() -> None:
    views, _, _ = three(flown(np.array([1.0, 0.0])))
    first, third, second = views
    assert middle_view(views, first, second) is third
    assert middle_view([first, second], first, second) is None
