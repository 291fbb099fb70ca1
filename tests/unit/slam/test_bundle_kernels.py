"""Bundle adjustment kernels against dense matrices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from companion.geometry.transforms import Array, rotation_from_vector
from companion.slam.compiled.bundle_kernels import (
    back_substitute,
    damped_inverses,
    errors,
    normal_equations,
    schur_complement,
)
from companion.slam.features.orb_features import Ints

N_VARIABLE, N_CAMERAS, N_POINTS = 3, 5, 12
STEP = 1e-6
HUBER = np.sqrt(5.991)


@dataclass
class Scene:
    rotation: Array
    translation: Array
    points: Array
    camera: Ints
    point: Ints
    seen: Array
    whitening: Array

    def errors(self) -> tuple[Array, Array, float]:
        return errors(
            self.rotation, self.translation, self.points, self.camera, self.point, self.seen,
            self.whitening,
        )  # fmt: skip

    def moved(self, by: Array) -> Array:
        """Errors (2 O,) after steps of cameras and points (6 V + 3 P,)."""
        rotation, translation = self.rotation.copy(), self.translation.copy()
        for k, move in enumerate(by[: 6 * N_VARIABLE].reshape(-1, 6)):
            turn = rotation_from_vector(move[:3])
            rotation[k], translation[k] = turn @ rotation[k], turn @ translation[k] + move[3:]
        points = self.points + by[6 * N_VARIABLE :].reshape(-1, 3)
        _, found, _ = Scene(
            rotation, translation, points, self.camera, self.point, self.seen, self.whitening
        ).errors()
        return found.ravel()


@pytest.fixture
def scene() -> Scene:
    """Few observations with large errors, one behind its camera, one unobserved point."""
    rng = np.random.default_rng(4)
    rotation = np.stack([rotation_from_vector(v) for v in rng.normal(scale=0.2, size=(5, 3))])
    translation = rng.normal(scale=0.5, size=(5, 3)) + [0.0, 0.0, 6.0]
    points = rng.uniform(-2, 2, (N_POINTS, 3))
    pairs = [(c, p) for c in range(N_CAMERAS) for p in range(N_POINTS - 1) if (c + 2 * p) % 4]
    camera, point = np.array(pairs)[rng.permutation(len(pairs))].T
    inside = np.einsum("oij,oj->oi", rotation[camera], points[point]) + translation[camera]
    seen = inside[:, :2] / inside[:, 2:] + rng.normal(scale=0.002, size=(len(camera), 2))
    seen[:6] += 0.05
    whitening = np.eye(2) * 400.0 + rng.normal(scale=50.0, size=(len(camera), 2, 2))
    points[0] -= [0.0, 0.0, 30.0]
    return Scene(rotation, translation, points, camera, point, seen, whitening)


def in_full(scene: Scene) -> tuple[Array, Array]:
    """Dense information and gradient by finite differences."""
    inside, residual, _ = scene.errors()
    n = 6 * N_VARIABLE + 3 * N_POINTS
    jacobian = np.stack(
        [(scene.moved(STEP * d) - scene.moved(-STEP * d)) / (2 * STEP) for d in np.eye(n)], 1
    )
    size = np.linalg.norm(residual, axis=1)
    weight = np.repeat(np.minimum(1.0, HUBER / size) * (inside[:, 2] > 0), 2)
    return jacobian.T @ (weight[:, None] * jacobian), jacobian.T @ (weight * residual.ravel())


def test_errors_and_loss_match_their_definition(scene: Scene) -> None:
    inside, residual, cost = scene.errors()
    by_hand = np.stack(
        [
            scene.rotation[c] @ scene.points[p] + scene.translation[c]
            for c, p in zip(scene.camera, scene.point, strict=True)
        ]
    )
    np.testing.assert_allclose(inside, by_hand, atol=1e-12)
    off = by_hand[:, :2] / by_hand[:, 2:] - scene.seen
    np.testing.assert_allclose(residual, np.einsum("oij,oj->oi", scene.whitening, off), rtol=1e-9)
    size = np.linalg.norm(residual, axis=1)
    loss = np.where(size < HUBER, size**2 / 2, HUBER * (size - HUBER / 2))
    loss[by_hand[:, 2] <= 0] = 100 * HUBER
    assert cost == pytest.approx(loss.sum(), rel=1e-12)
    assert 0 < np.count_nonzero(by_hand[:, 2] <= 0) < 6


def test_normal_equations_match_the_dense_matrix(scene: Scene) -> None:
    inside, residual, _ = scene.errors()
    whole, gradient = in_full(scene)
    hcc, gc, hpp, gp, hcp = normal_equations(
        scene.rotation, inside, residual, scene.camera, scene.point, scene.whitening, N_VARIABLE,
        N_POINTS,
    )  # fmt: skip
    summed, edge = np.zeros_like(whole), 6 * N_VARIABLE
    for k in range(N_VARIABLE):
        summed[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = hcc[k]
    for p in range(N_POINTS):
        at = edge + 3 * p
        summed[at : at + 3, at : at + 3] = hpp[p]
    for c, p, tie in zip(scene.camera, scene.point, hcp, strict=True):
        if c < N_VARIABLE:
            summed[6 * c : 6 * c + 6, edge + 3 * p : edge + 3 * p + 3] += tie
            summed[edge + 3 * p : edge + 3 * p + 3, 6 * c : 6 * c + 6] += tie.T
    np.testing.assert_allclose(summed, whole, atol=1e-5 * np.abs(whole).max())
    np.testing.assert_allclose(
        np.r_[gc.ravel(), gp.ravel()], gradient, atol=1e-5 * np.abs(gradient).max()
    )
    assert not hpp[N_POINTS - 1].any()


def test_schur_complement_and_back_substitution_match_the_dense_solution(scene: Scene) -> None:
    inside, residual, _ = scene.errors()
    _, _, hpp, gp, hcp = normal_equations(
        scene.rotation, inside, residual, scene.camera, scene.point, scene.whitening, N_VARIABLE,
        N_POINTS,
    )  # fmt: skip
    inverse = np.asarray(np.linalg.inv(hpp + 3.0 * np.eye(3)), np.float64)
    moving = np.flatnonzero(scene.camera < N_VARIABLE)
    by_point: Ints = moving[np.argsort(scene.point[moving], kind="stable")]
    taken, added = schur_complement(
        inverse, gp, hcp, scene.camera, scene.point, by_point, N_VARIABLE
    )
    ties = np.zeros((6 * N_VARIABLE, 3 * N_POINTS))
    for o in moving:
        c, p = scene.camera[o], scene.point[o]
        ties[6 * c : 6 * c + 6, 3 * p : 3 * p + 3] += hcp[o]
    blocks = np.zeros((3 * N_POINTS, 3 * N_POINTS))
    for p in range(N_POINTS):
        blocks[3 * p : 3 * p + 3, 3 * p : 3 * p + 3] = inverse[p]
    wanted = ties @ blocks @ ties.T
    np.testing.assert_allclose(taken, wanted, rtol=1e-9, atol=1e-9 * np.abs(wanted).max())
    np.testing.assert_allclose(added, ties @ blocks @ gp.ravel(), rtol=1e-9, atol=1e-6)
    moves = np.random.default_rng(1).normal(size=(N_VARIABLE, 6))
    moved = back_substitute(inverse, gp, hcp, scene.camera, scene.point, by_point, moves)
    np.testing.assert_allclose(
        moved.ravel(), blocks @ (-gp.ravel() - ties.T @ moves.ravel()), rtol=1e-9, atol=1e-9
    )


def test_damped_inverses_are_those_of_points_hardly_and_never_observed() -> None:
    """Of a direction that is known a thousand times worse than another, and of no information."""
    rng = np.random.default_rng(3)
    seen = rng.normal(size=(40, 6, 3)) * np.array([1e3, 3e2, 1.0])
    turned = seen @ np.linalg.qr(rng.normal(size=(40, 3, 3)))[0]
    information = np.concatenate([turned.transpose(0, 2, 1) @ turned, np.zeros((1, 3, 3))])
    damped = information + np.stack(
        [np.diag(0.01 * np.diag(each) + 1e-9) for each in information]
    )  # fmt: skip
    found = damped_inverses(information, 0.01)
    np.testing.assert_array_equal(found, found.transpose(0, 2, 1))
    np.testing.assert_allclose(found @ damped, np.tile(np.eye(3), (41, 1, 1)), atol=1e-10)


def test_no_observations_give_zero_sums() -> None:
    none, whole = np.zeros(0, np.int64), np.zeros((0, 2, 2))
    turn, place, points = np.eye(3)[None], np.zeros((1, 3)), np.ones((2, 3))
    inside, residual, cost = errors(turn, place, points, none, none, np.zeros((0, 2)), whole)
    assert cost == 0.0
    hcc, gc, hpp, gp, hcp = normal_equations(turn, inside, residual, none, none, whole, 1, 2)
    assert not (hcc.any() or gc.any() or hpp.any() or gp.any())
    taken, added = schur_complement(hpp, gp, hcp, none, none, none, 1)
    assert taken.shape == (6, 6) and not taken.any() and not added.any()
