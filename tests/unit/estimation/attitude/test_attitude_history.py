"""Attitude at any time: interpolated and extrapolated, but not across gaps."""

from __future__ import annotations

import numpy as np
import pytest

from companion.estimation.attitude.attitude_history import AttitudeHistory
from companion.geometry.transforms import quaternion_from_euler
from companion.telemetry import AttitudeSample


def sample(t_ns: int, yaw_rad: float, rate_rad_s: float | None = None) -> AttitudeSample:
    rates = None if rate_rad_s is None else np.array([0.0, 0.0, rate_rad_s])
    return AttitudeSample(t_ns, quaternion_from_euler(0.0, 0.0, yaw_rad), rates)


def yaw_at(history: AttitudeHistory, t_ns: int) -> float:
    rotation = history.at(t_ns)
    assert rotation is not None
    return float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def test_attitude_is_interpolated_and_extrapolated_by_its_rate() -> None:
    history = AttitudeHistory()
    history.add(sample(0, 0.10, 2.0))
    history.add(sample(100_000_000, 0.30, 2.0))
    assert yaw_at(history, 25_000_000) == pytest.approx(0.15)
    assert yaw_at(history, 150_000_000) == pytest.approx(0.40)
    assert history.at(900_000_000) is None, "too long ago"


def test_late_samples_are_sorted_and_duplicates_ignored() -> None:
    history = AttitudeHistory()
    for t_ns, yaw in ((0, 0.0), (200_000_000, 0.4), (100_000_000, 0.1), (100_000_000, 3.0)):
        history.add(sample(t_ns, yaw))
    assert yaw_at(history, 150_000_000) == pytest.approx(0.25)
    assert history.newest_t_ns == 200_000_000


def test_gap_is_not_interpolated() -> None:
    history = AttitudeHistory()
    history.add(sample(0, 0.0))
    history.add(sample(2_000_000_000, 1.0))
    assert history.at(1_000_000_000) is None


def test_attitude_extrapolation_is_limited() -> None:
    """In gusts a craft rotates by degrees within two tenths of a second."""
    history = AttitudeHistory()
    history.add(sample(0, 0.0))
    assert history.at(100_000_000) is not None
    assert history.at(-100_000_000) is not None
    assert history.at(150_000_000) is None
