from __future__ import annotations

import time
import tracemalloc

import numpy as np
import pytest

from companion.timing.clock import MIN_MS, StageTimes

FRAMES = 3600 * 30


def test_percentiles_are_those_of_all_durations() -> None:
    durations = np.random.default_rng(1).lognormal(2.0, 0.8, 5000)
    times = StageTimes()
    for ms in durations.tolist():
        times.add("tracking", ms)
    found = times.summary()["tracking"]
    assert found["n"] == 5000
    assert found["total_s"] == pytest.approx(durations.sum() / 1e3, abs=1e-3)
    assert found["p50_ms"] == pytest.approx(np.percentile(durations, 50), rel=0.011)
    assert found["p95_ms"] == pytest.approx(np.percentile(durations, 95), rel=0.011)
    assert times.total_ms("tracking") == pytest.approx(durations.sum())
    assert times.total_ms("never") == 0.0


def test_few_durations_and_odd_ones() -> None:
    times = StageTimes()
    times.add("one", 12.345)
    assert times.summary()["one"] == {"n": 1, "p50_ms": 12.345, "p95_ms": 12.345, "total_s": 0.012}
    times.add("two", 10.0)
    times.add("two", 20.0)
    assert times.summary()["two"]["p50_ms"] == pytest.approx(15.0, rel=0.011)
    for ms in (0.0, MIN_MS / 2, 1e12):
        times.add("odd", ms)
    assert times.summary()["odd"]["p50_ms"] == pytest.approx(MIN_MS, rel=1.0)
    assert times.summary()["odd"]["p95_ms"] > 1e6


def test_hours_of_flight_cost_no_more_than_minutes() -> None:
    """Each second a stage tells its times: 49 ms after an hour, when they were a list."""
    times = StageTimes()
    for ms in np.random.default_rng(2).lognormal(2.0, 0.5, FRAMES // 12).tolist():
        times.add("tracking", ms)
    times.summary()
    tracemalloc.start()
    try:
        for ms in np.random.default_rng(3).lognormal(2.0, 0.5, FRAMES).tolist():
            times.add("tracking", ms)
        kept, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert kept < 100_000
    began_s = time.thread_time()
    for _ in range(20):
        times.summary()
    assert (time.thread_time() - began_s) / 20 < 0.002
