"""Pose refinement kernel against numpy."""

from __future__ import annotations

import numpy as np
import pytest

from companion.geometry.transforms import Array, Pose, rotation_from_vector
from companion.slam.optimisation.pose_refinement import refine_pose, robust_cost
from tests.support.reference import numpy_kernels

Sight = tuple[Pose, Array, Array, Array]


def sight(n: int, noise: float = 1e-3) -> Sight:
    """An initial pose off the truth, points, some behind, and observations, a third of them
    outliers."""
    rng = np.random.default_rng(n)
    pose = Pose(rotation_from_vector(np.array([0.3, -0.2, 0.1])), np.array([0.5, -1.0, 4.0]))
    points = rng.normal(size=(n, 3)) * [3.0, 2.0, 1.0]
    in_camera = pose.apply(points)
    seen = in_camera[:, :2] / in_camera[:, 2:] + rng.normal(scale=noise, size=(n, 2))
    seen[: n // 3] += rng.uniform(-0.3, 0.3, (n // 3, 2))
    points[: n // 9] -= [0.0, 0.0, 20.0]
    whitening = rng.uniform(0.5, 1.5, (n, 2, 2)) * 400.0 * np.eye(2) + rng.normal(size=(n, 2, 2))
    turn = rotation_from_vector(np.array([0.02, -0.01, 0.03]))
    return Pose(turn @ pose.rotation, pose.translation + 0.05), points, seen, whitening


@pytest.mark.parametrize("rounds", [1, 2, 4])
@pytest.mark.parametrize("n", [6, 7, 40, 500])
def test_pose_refinement_matches_numpy(n: int, rounds: int) -> None:
    start, points, seen, whitening = sight(n)
    pose, inlier, information = refine_pose(start, points, seen, whitening, rounds)
    wanted, agree, known = numpy_kernels.refine_pose(start, points, seen, whitening, rounds)
    np.testing.assert_array_equal(inlier, agree)
    np.testing.assert_allclose(pose.matrix(), wanted.matrix(), atol=1e-9)
    np.testing.assert_allclose(information, known, rtol=1e-7, atol=1e-7 * np.abs(known).max())


def test_loss_matches_numpy() -> None:
    found = sight(101)
    loss = numpy_kernels.robust_cost(*found)
    assert robust_cost(*found) == pytest.approx(loss, rel=1e-12)
    ahead = (found[0], found[1][20:], found[2][20:], found[3][20:])
    assert robust_cost(*ahead) < loss


@pytest.mark.parametrize("n", [0, 1, 5])
def test_too_few_points_leave_the_pose_unchanged(n: int) -> None:
    start, points, seen, whitening = sight(n)
    pose, inlier, information = refine_pose(start, points, seen, whitening)
    np.testing.assert_allclose(pose.matrix(), start.matrix(), atol=1e-12)
    assert inlier.shape == (n,)
    assert not information.any()
    assert robust_cost(start, *(a[:0] for a in (points, seen, whitening))) == 0.0


def test_points_that_are_nan_are_no_inliers() -> None:
    start, points, seen, whitening = sight(30, noise=0.0)
    points[:] = np.nan
    _, inlier, _ = refine_pose(start, points, seen, whitening)
    assert not inlier.any()


def test_non_contiguous_arrays_are_accepted() -> None:
    start, points, seen, whitening = sight(60)
    turned = Pose(np.asfortranarray(start.rotation), start.translation)
    other = refine_pose(
        turned, np.asfortranarray(points), np.repeat(seen, 2, 1)[:, ::2], whitening[::-1][::-1]
    )
    np.testing.assert_array_equal(
        other[0].matrix(), refine_pose(start, points, seen, whitening)[0].matrix()
    )
    assert points.flags.c_contiguous  # and what was given stays as it was
