"""Displacement factor in bundle adjustment: it holds the scale where images hardly do."""

from __future__ import annotations

import numpy as np
import pytest

from companion.geometry.transforms import Array, Pose, rotation_from_vector
from companion.slam.optimisation.bundle_adjustment import Bundle, adjust
from companion.slam.optimisation.displacement_factor import (
    MAX_TYPICAL_ERROR,
    DisplacementFactor,
    typical_error,
)
from tests.support.reference.nadir_cameras import FOCAL, LOOKING_DOWN

TO_WORLD = 2.0 * rotation_from_vector(np.array([0.1, -0.2, 0.7]))
N = 24


def poses_of(cameras: list[Pose]) -> tuple[Array, Array]:
    return np.stack([p.rotation for p in cameras]), np.stack([p.translation for p in cameras])


def centres(cameras: list[Pose]) -> Array:
    return np.stack([p.inverse().translation for p in cameras])


def measured(cameras: list[Pose], rng: np.random.Generator, sigma_m: float) -> DisplacementFactor:
    """Displacement factor between consecutive cameras."""
    displacement_m = np.diff(centres(cameras), axis=0) @ TO_WORLD.T
    n = len(displacement_m)
    return DisplacementFactor(
        np.arange(n), np.arange(1, n + 1), displacement_m + rng.normal(scale=sigma_m, size=(n, 3)),
        np.full(n, sigma_m), TO_WORLD,
    )  # fmt: skip


def test_gradient_matches_the_cost(rng: np.random.Generator) -> None:
    cameras = [Pose(rotation_from_vector(rng.normal(size=3)), rng.normal(size=3)) for _ in range(6)]
    factor = measured(cameras, rng, 0.2)
    factor.displacement_m[1, 2] = np.nan
    factor.displacement_m[3] += 4.0
    rotation, translation = poses_of(cameras)
    translation = translation + rng.normal(scale=0.1, size=translation.shape)
    information, gradient = np.zeros((4, 6, 4, 6)), np.zeros((4, 6))
    factor.add_normal_equations(information, gradient, rotation, translation)
    flat = information.reshape(24, 24)
    assert flat == pytest.approx(flat.T)
    assert np.linalg.eigvalsh(flat).min() > -1e-6
    step = 1e-6
    for camera in range(4):
        for axis in range(6):
            move = step * np.eye(6)[axis]
            r, t = rotation.copy(), translation.copy()
            turn = rotation_from_vector(move[:3])
            r[camera], t[camera] = turn @ r[camera], turn @ t[camera] + move[3:]
            slope = (factor.cost(r, t) - factor.cost(rotation, translation)) / step
            assert gradient[camera, axis] == pytest.approx(slope, rel=1e-3, abs=2e-2)


@pytest.mark.parametrize("wrong", [False, True], ids=["all right", "one is wrong"])
def test_scale_drift_with_few_points_is_held(rng: np.random.Generator, wrong: bool) -> None:
    """A dozen points per image and a path that shrinks: images alone leave it short."""
    truth = [Pose(LOOKING_DOWN, -LOOKING_DOWN @ np.array([0.5 * k, 0.0, -4.0])) for k in range(N)]
    n = 12 * N
    ground = np.c_[rng.uniform(-2, 0.5 * N + 2, n), rng.uniform(-2, 2, n), np.zeros(n)]
    camera, point, seen = [], [], []
    for k, pose in enumerate(truth):
        p = pose.apply(ground)
        near = np.flatnonzero((np.abs(p[:, :2]) < 2.0).all(1))[::4]
        camera.append(np.full(len(near), k))
        point.append(near)
        where = p[near, :2] / p[near, 2:]
        seen.append(where + rng.normal(scale=1.5 / FOCAL, size=where.shape))
    shrunk = np.cumprod(np.full(N, 0.985))
    start = [
        Pose(p.rotation, -p.rotation @ np.array([0.5 * shrunk[:k].sum(), 0.0, -4.0 * shrunk[k]]))
        for k, p in enumerate(truth)
    ]
    start[:2] = truth[:2]
    order = [*range(2, N), 0, 1]
    place = np.argsort(order)
    factor = measured(truth, rng, 0.03)
    factor = DisplacementFactor(
        place[factor.first], place[factor.second], factor.displacement_m, factor.sigma_m, TO_WORLD
    )
    if wrong:
        factor.displacement_m[10] = [5.0, -5.0, 0.0]

    def off(factor: DisplacementFactor | None) -> float:
        bundle = Bundle(
            [start[k] for k in order], N - 2, ground.copy(), place[np.concatenate(camera)],
            np.concatenate(point), np.concatenate(seen),
            np.broadcast_to(np.eye(2) * FOCAL, (len(np.concatenate(camera)), 2, 2)),
            () if factor is None else (factor,),
        )  # fmt: skip
        result = adjust(bundle, 30)
        found = [result.poses[int(place[k])] for k in range(N)]
        return float(np.linalg.norm(centres(found) - centres(truth), axis=1).max())

    assert off(factor) < 0.25
    assert off(factor) < 0.6 * off(None)


def test_displacements_that_do_not_fit_the_map_are_not_used(rng: np.random.Generator) -> None:
    cameras = [Pose(LOOKING_DOWN, np.array([0.4 * k, 0.1 * k, 4.0])) for k in range(N)]
    factor = measured(cameras, rng, 0.1)
    error = typical_error(factor, *poses_of(cameras))
    assert error == pytest.approx(1.0, rel=0.4)
    factor.displacement_m[:] = -factor.displacement_m * 2 * MAX_TYPICAL_ERROR
    assert typical_error(factor, *poses_of(cameras)) is None
