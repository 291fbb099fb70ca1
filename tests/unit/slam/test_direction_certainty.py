"""The stated certainty of a direction of motion, against what noise does to it."""

from __future__ import annotations

import numpy as np
import pytest

from companion.geometry.transforms import Array, Pose, rotation_from_vector
from companion.slam.initialisation.direction_certainty import direction_sigma_rad
from companion.slam.optimisation.bundle_adjustment import Bundle, adjust
from companion.slam.optimisation.rotation_factor import RelativeRotationFactor

FOCAL_PX, N = 300.0, 150
WAY, PRIOR_RAD = 0.05, np.radians(0.2)
TRUE = Pose(rotation_from_vector(np.array([0.02, -0.03, 0.05])), np.array([1.0, 0.2, 0.1]))
WHITENING = np.tile(FOCAL_PX * np.eye(2), (N, 1, 1))


def seen(rng: np.random.Generator, relief: float) -> tuple[Pose, Array, Array]:
    """Motion with a unit baseline, and two noisy views (N, 2) of ground below, WAY of its depth."""
    direction = TRUE.translation / np.linalg.norm(TRUE.translation)
    points = np.c_[rng.uniform(-0.5, 0.5, (N, 2)), 1 + rng.uniform(-relief, relief, N)] / WAY
    pose = Pose(TRUE.rotation, direction)
    moved = pose.apply(points)
    noise = rng.normal(scale=1 / FOCAL_PX, size=(2, N, 2))
    return pose, points[:, :2] / points[:, 2:] + noise[0], moved[:, :2] / moved[:, 2:] + noise[1]


def found(pose: Pose, a: Array, b: Array, rng: np.random.Generator) -> Pose:
    """Bundle adjustment from the truth, with a rotation that is off as the prior says."""
    off = rotation_from_vector(rng.normal(scale=PRIOR_RAD, size=3))
    factor = RelativeRotationFactor(
        np.array([1]), np.array([0]), (off @ pose.rotation)[None], np.array([PRIOR_RAD])
    )
    points = np.c_[a, np.ones(N)] / WAY
    bundle = Bundle(
        [pose, Pose.identity()], 1, points, np.repeat([0, 1], N), np.tile(np.arange(N), 2),
        np.r_[b, a], np.r_[WHITENING, WHITENING], (factor,),
    )  # fmt: skip
    return adjust(bundle, 12).poses[0]


@pytest.mark.parametrize("relief", [0.0, 0.3])
def test_it_is_what_noise_does(relief: float) -> None:
    rng = np.random.default_rng(3)
    off, sigmas = [], []
    for _ in range(40):
        pose, a, b = seen(rng, relief)
        way = found(pose, a, b, rng).translation
        across = way / np.linalg.norm(way) - pose.translation
        off.append(across @ across)
        sigmas.append(direction_sigma_rad(pose, a, b, WHITENING, WHITENING, float(PRIOR_RAD)))
    # of two directions across that of less certainty is stated: over a plane both are alike
    assert 0.6 < np.sqrt(np.mean(off)) / np.mean(sigmas) < 1.9


def test_a_plane_is_uncertain_and_a_prior_or_relief_helps() -> None:
    pose, a, b = seen(np.random.default_rng(1), 0.0)
    alone = direction_sigma_rad(pose, a, b, WHITENING, WHITENING, None)
    with_prior = direction_sigma_rad(pose, a, b, WHITENING, WHITENING, 1e-3)
    pose, a, b = seen(np.random.default_rng(1), 0.3)
    with_relief = direction_sigma_rad(pose, a, b, WHITENING, WHITENING, None)
    assert alone > 2 * with_prior and alone > 1.4 * with_relief


def test_without_a_match_nothing_is_known() -> None:
    none = np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros((0, 2, 2))
    assert direction_sigma_rad(TRUE, *none, None) == float("inf")
