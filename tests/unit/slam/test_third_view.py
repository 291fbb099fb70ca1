"""Third-view consistency check of true and false reconstructions, and of two that compete."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from companion.geometry.transforms import Array, Pose, angle_between, rotation_from_vector
from companion.slam.features.orb_features import Features
from companion.slam.features.view import View
from companion.slam.initialisation.initializer import TwoViewGeometry, initialise
from companion.slam.initialisation.third_view import middle_view, third_view_rejects
from tests.support.reference.synthetic_map import GREY, Ground, flown

STEP_NS = 100_000_000
FOCAL_PX, N = 500.0, 300


def view(k: int, features: Features) -> View:
    unknown = np.full(len(features), -1)
    return View(k, k * STEP_NS, features, None, GREY, Pose.identity(), unknown)


def three(middle: Pose) -> tuple[list[View], TwoViewGeometry]:
    """Views from 0, m and 2 m to the north, and the geometry of the outer two."""
    ground = Ground(np.random.default_rng(4))
    poses = [flown(np.array([0.0, 0.0])), middle, flown(np.array([2.0, 0.0]))]
    seen = [ground.seen_from(pose) for pose in poses]
    first, second = poses[0].inverse(), poses[2].inverse()
    features = np.arange(len(seen[0][1]))
    found = TwoViewGeometry(
        second @ first.inverse(), first.apply(ground.points[seen[0][1]]), features, features
    )
    return [view(k, each) for k, (each, _) in enumerate(seen)], found


def test_true_reconstruction_passes_though_the_camera_rotated() -> None:
    (first, third, second), found = three(flown(np.array([1.2, 0.4]), 0.1))
    assert not third_view_rejects(third, first, second, found)


def test_depth_inverted_reconstruction_is_rejected() -> None:
    (first, third, second), found = three(flown(np.array([1.2, 0.4]), 0.1))
    depth = found.points_a[:, 2:]
    wrong = found.points_a * (9.0 - 3.0 * (depth - 9.0)) / depth  # on the same rays
    assert third_view_rejects(third, first, second, replace(found, points_a=wrong))


def test_view_without_overlap_does_not_reject() -> None:
    (first, third, second), found = three(flown(np.array([25.0, 25.0])))
    assert not third_view_rejects(third, first, second, found)


def test_middle_view_is_chosen() -> None:
    views, _ = three(flown(np.array([1.0, 0.0])))
    first, third, second = views
    assert middle_view(views, first, second) is third
    assert middle_view([first, second], first, second) is None


def past_a_slope(seed: int) -> tuple[list[View], TwoViewGeometry, Array]:
    """Views of a slope that is nearly flat, and the geometry that the outer two give.

    The camera is in a hand: the middle one is not between the others.
    """
    rng = np.random.default_rng(seed)
    rays = np.c_[rng.uniform(-0.4, 0.4, (N, 2)), np.ones(N)]
    relief = 1.0 + rng.uniform(-0.06, 0.06, N)
    points = rays * (10.0 / (1.0 - 0.5 * rays[:, 1]) * relief)[:, None]
    descriptors = rng.integers(0, 256, (N, 32)).astype(np.uint8)
    turn = rotation_from_vector(np.radians([1.0, 5.0, 0.5]))
    views = []
    for k, centre in enumerate(([0.0, 0.0, 0.0], [0.1, -0.4, -0.3], [0.5, -0.1, -0.24])):
        rotation = (np.eye(3), turn.T, turn)[k]
        seen = Pose(rotation, -rotation @ centre).apply(points)
        normalised = seen[:, :2] / seen[:, 2:] + rng.normal(scale=0.5 / FOCAL_PX, size=(N, 2))
        features = Features(
            np.asarray(normalised * FOCAL_PX, np.float32), normalised, np.zeros(N, np.int64),
            np.zeros(N, np.float32), descriptors, np.ones(N),
            np.tile(FOCAL_PX * np.eye(2), (N, 1, 1)),
        )  # fmt: skip
        views.append(view(k, features))
    index = np.arange(N)
    found = initialise(
        views[0].features, views[2].features, index, index, FOCAL_PX, seed, None, np.radians(1.0)
    )
    assert found is not None
    return views, found, turn


@pytest.mark.parametrize("seed", range(5))
def test_third_view_tells_a_slope_from_its_mirror(seed: int) -> None:
    """Two views show a slope twice: as it is, and as another that is passed another way."""
    (first, third, second), found, turn = past_a_slope(seed)
    assert np.degrees(angle_between(found.b_from_a.rotation, turn)) < 1.0
    assert found.competing
    for mirror in found.competing:
        assert found.b_from_a.translation @ mirror.b_from_a.translation < 0.5
        mistaken = replace(mirror, competing=(found,))
        assert third_view_rejects(third, first, second, mistaken)
    assert not third_view_rejects(third, first, second, found)


def test_what_may_be_another_waits_for_a_third_view() -> None:
    (first, _, second), found, _ = past_a_slope(0)
    assert third_view_rejects(None, first, second, found)
    assert not third_view_rejects(None, first, second, replace(found, competing=()))
