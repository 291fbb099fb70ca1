"""Consistency of the smooth pose's covariance, on a flight with ground truth."""

from __future__ import annotations

from pathlib import Path

from companion.app.progress import Progress
from companion.config import Config
from tests.bench.accuracy.bench_slam import bench_slam

SAMPLE = Path(__file__).parents[2] / "sample" / "survey"


def test_errors_are_as_large_as_the_covariance_says() -> None:
    """Mean square error of ten seconds' way over the stated variance: 1 would be exact.

    An autopilot that is told of a smaller error than there is will trust a wrong pose: not above
    1.5. Below 0.1 the pose would be worth less to it than it is.
    """
    (row,) = bench_slam([SAMPLE], Config(), None, faults=False, above_m=None, progress=Progress())
    assert row.nees is not None
    assert 0.1 < row.nees < 1.5
    # the heading's error hardly changes in a flight: within two standard deviations, and not said
    # to be so large that an autopilot would leave it aside
    assert row.nees_yaw is not None
    assert 0.02 < row.nees_yaw < 4.0
    assert row.resets == 0
