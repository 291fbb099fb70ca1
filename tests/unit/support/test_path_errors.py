"""Trajectory errors of synthetic paths, and against evo."""

from __future__ import annotations

import numpy as np
import pytest

from companion.geometry.transforms import (
    Array,
    quaternion_from_rotation,
    rotation_from_vector,
    yaw_rotation,
)
from tests.bench.accuracy.path_errors import Path, path_errors


def made_path(n: int = 200) -> Path:
    k: Array = np.arange(n, dtype=np.float64)
    centres = np.stack([20 * np.cos(k / 30), 15 * np.sin(k / 25), -10 - 2 * np.sin(k / 9)], 1)
    rotations = np.stack(
        [rotation_from_vector(np.array([0.1 * np.sin(i / 7), 0.2, i / 50])) for i in k]
    )
    return Path(k * 100_000_000.0, centres, rotations)


def disturbed(path: Path, rng: np.random.Generator, position_m: float, turn_rad: float) -> Path:
    turns = np.stack(
        [rotation_from_vector(v) for v in rng.normal(scale=turn_rad, size=(len(path), 3))]
    )
    return Path(
        path.t_ns, path.centres + rng.normal(scale=position_m, size=path.centres.shape),
        np.matmul(path.rotations, turns),
    )  # fmt: skip


def moved(path: Path, scale: float, rotation: Array, shift: Array) -> Path:
    return Path(
        path.t_ns, scale * path.centres @ rotation.T + shift, np.matmul(rotation, path.rotations)
    )


def test_a_path_in_another_world_differs_by_that_alone() -> None:
    truth = made_path()
    errors = path_errors(moved(truth, 0.98, yaw_rotation(0.1), np.array([5.0, -3, 1])), truth)
    assert errors is not None
    assert errors.ate_sim3_m < 1e-9
    assert errors.rpe_m < 1e-9
    assert errors.scale_error == pytest.approx(0.02)
    assert errors.heading_error_deg == pytest.approx(np.degrees(0.1))
    assert errors.ate_se3_m == pytest.approx(errors.ate_yaw_m)
    assert errors.ate_se3_m > 0.1


def test_frames_that_only_one_has_do_not_count() -> None:
    truth = made_path()
    half = truth.at(np.arange(0, 200, 2))
    shifted = Path(half.t_ns + 10_000_000, half.centres, half.rotations)
    found = path_errors(half, truth)
    assert found is not None
    assert found.n_common == 100
    assert path_errors(shifted, truth) is None


def test_figures_are_those_of_evo() -> None:
    metrics = pytest.importorskip("evo.core.metrics")
    trajectory = pytest.importorskip("evo.core.trajectory")
    truth = made_path()
    rng = np.random.default_rng(4)
    estimate = moved(
        disturbed(truth, rng, 0.05, 0.004), 1.03, rotation_from_vector(np.array([0.1, 0.2, 0.7])),
        np.array([1.0, 2, 3]),
    )  # fmt: skip
    errors = path_errors(estimate, truth)
    assert errors is not None

    def theirs(path: Path) -> object:
        turns = np.stack([quaternion_from_rotation(r) for r in path.rotations])
        return trajectory.PoseTrajectory3D(path.centres, turns, path.t_ns * 1e-9)

    def rmse(metric: object, correct_scale: bool) -> float:
        reference, aligned = theirs(truth), theirs(estimate)
        aligned.align(reference, correct_scale=correct_scale)  # type: ignore[attr-defined]
        metric.process_data((reference, aligned))  # type: ignore[attr-defined]
        return float(metric.get_statistic(metrics.StatisticsType.rmse))  # type: ignore[attr-defined]

    translation = metrics.PoseRelation.translation_part
    angle = metrics.PoseRelation.rotation_angle_deg
    assert rmse(metrics.APE(translation), True) == pytest.approx(errors.ate_sim3_m)
    assert rmse(metrics.APE(translation), False) == pytest.approx(errors.ate_se3_m)
    assert rmse(metrics.RPE(translation), True) == pytest.approx(errors.rpe_m)
    assert rmse(metrics.RPE(angle), True) == pytest.approx(errors.rpe_deg)
    assert rmse(metrics.APE(angle), False) == pytest.approx(errors.rotation_deg)
