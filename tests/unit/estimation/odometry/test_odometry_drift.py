"""Drift of the last seconds: what is stated of a scale that is off, and for how long."""

from __future__ import annotations

import numpy as np
import pytest

from companion.estimation.odometry.odometry_drift import OdometryDrift

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


def test_what_is_longer_ago_is_forgotten() -> None:
    drift = OdometryDrift()
    for k in range(30):
        north_m = min(1.0 * k, 10.0)  # stands from the tenth second on
        found = drift.add(k * 10**9, np.array([north_m, 0.0, 0.0]), SIGMA_SCALE, np.zeros(3))
    assert found.by_scale_m == found.by_map_m == 0.0
