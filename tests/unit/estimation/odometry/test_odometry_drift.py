"""Drift of the last seconds: what is stated of a scale that is off, and for how long."""

from __future__ import annotations

import numpy as np
import pytest

from companion.estimation.odometry.odometry_drift import ALONG_ONE, OdometryDrift

SIGMA_SCALE = 0.02


def test_a_scale_that_is_off_exceeds_the_bound_as_often_as_it_should() -> None:
    """Errors are along the way, what is stated is along each axis: one in twenty beyond 95 %."""
    drift, way = OdometryDrift(), np.array([30.0, -12.0, 4.0])
    drift.add(0, np.zeros(3), SIGMA_SCALE, np.zeros(3))
    stated_m = drift.add(5_000_000_000, way, SIGMA_SCALE, np.zeros(3)).by_scale_m
    off = np.random.default_rng(1).normal(scale=SIGMA_SCALE, size=20000)
    squares = np.square(off[:, None] * way).sum(1) / stated_m**2
    assert float(np.mean(squares > 7.815)) == pytest.approx(0.05, abs=0.005)
    assert 0.5 < float(np.mean(squares)) / 3.0 < 1.0


def test_a_scale_that_becomes_certain_leaves_the_way_before_as_uncertain_as_it_was() -> None:
    """What it was off by then is in the places that were given out."""
    drift = OdometryDrift()
    for k in range(16):
        sigma = 0.04 if k <= 5 else 0.01
        found = drift.add(k * 10**9, np.array([2.0 * k, 0.0, 0.0]), sigma, np.zeros(3))
        if k == 10:
            way_m = 5 * 2.0 * 0.04 + 5 * 2.0 * 0.01
            assert found.by_scale_m == pytest.approx(ALONG_ONE * way_m)
    assert found.by_scale_m == pytest.approx(ALONG_ONE * 20.0 * 0.01)


def test_what_is_longer_ago_is_forgotten() -> None:
    drift = OdometryDrift()
    for k in range(30):
        north_m = min(1.0 * k, 10.0)  # stands from the tenth second on
        found = drift.add(k * 10**9, np.array([north_m, 0.0, 0.0]), SIGMA_SCALE, np.zeros(3))
    assert found.by_scale_m == found.by_map_m == 0.0


@pytest.mark.parametrize("keyframes_a_view", [1, 2, 4, 8])
def test_drift_over_new_ground_is_what_a_chain_of_views_drifts_by(keyframes_a_view: int) -> None:
    """Points bear the error of the pose that made them, poses the mean one of what they see.

    Many keyframes a view average their noise, which is not counted on.
    """
    rng, noise_m, squares = np.random.default_rng(keyframes_a_view), 0.05, []
    for _ in range(300):
        drift = OdometryDrift()
        errors_m = [np.zeros(3)] * keyframes_a_view  # of the points of the keyframes in view
        for k in range(3 * keyframes_a_view + 1):
            drift.see(np.arange(k, k + keyframes_a_view))
            found = drift.add(k * 10**8, np.zeros(3), 0.0, np.zeros(3), noise_m)
            pose_m = np.mean(errors_m, axis=0) + rng.normal(scale=noise_m, size=3)
            errors_m = [*errors_m[1:], pose_m]
        squares.append(float((pose_m**2).sum()) / (found.by_map_m**2 + noise_m**2) / 3.0)
    assert 0.3 < np.mean(squares) < 1.2


def test_drift_stops_over_known_ground_and_goes_on_with_new_points() -> None:
    drift = OdometryDrift()

    def over(born: list[int], k: int) -> float:
        drift.see(np.array(born, np.int64))
        return drift.add(k * 10**8, np.zeros(3), 0.0, np.zeros(3), 0.1).by_map_m

    first = [over([0, 0, 1, 1], k) for k in range(10)]
    assert first[0] == first[-1] == 0.0
    half_new = over([1, 1, 2, 2], 10)
    assert half_new == pytest.approx(0.1 * np.sqrt(0.5))
    assert over([0, 1, 2, 2], 11) == over([0, 1], 12) == half_new
    assert over([], 13) > 0.1, "what is seen without a point that is known is not known ground"
