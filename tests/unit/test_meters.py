"""Rates and latencies of the last seconds, counted in any thread."""

from __future__ import annotations

import threading

import pytest

from companion.health import SourceHealth
from companion.meters import LatencyMeter, RateMeter, SourceMeter, StageMeter

S = 1_000_000_000
EPOCH_NS = 1_790_000_000 * S


def at(t_s: float) -> int:
    return EPOCH_NS + round(t_s * S)


@pytest.mark.parametrize("hz", [0.5, 30, 200])
def test_rate_is_that_of_the_last_seconds(hz: float) -> None:
    meter = RateMeter(window_s=5)
    for i in range(round(20 * hz)):
        meter.add(at(i / hz))
    assert meter.hz(at(20)) == pytest.approx(hz, abs=0.2)


def test_rate_falls_to_nothing_when_nothing_comes() -> None:
    meter = RateMeter(window_s=5)
    for i in range(300):
        meter.add(at(i / 30))
    assert meter.hz(at(12.5)) == pytest.approx(15, abs=0.5)
    assert meter.hz(at(14.9)) == pytest.approx(0.8, abs=0.5), "the last ones still count"
    assert meter.hz(at(16)) == 0


def test_rate_is_right_soon_after_the_start() -> None:
    meter = RateMeter(window_s=5)
    assert meter.hz(at(0)) == 0
    for i in range(16):
        meter.add(at(i / 30))
    assert meter.hz(at(15 / 30)) == pytest.approx(30, abs=0.1)


def test_rate_of_more_than_is_kept_is_still_right() -> None:
    meter = RateMeter(window_s=5)
    for i in range(20_000):
        meter.add(at(i / 2000))
    assert meter.hz(at(10)) == pytest.approx(2000, rel=0.01)


def test_latency_percentiles_are_of_the_last_seconds() -> None:
    meter = LatencyMeter(window_s=5)
    assert meter.percentile_ms(50, at(0)) is None
    for i in range(100):
        meter.add(at(i / 100), 1000.0)
    for i in range(1, 101):
        meter.add(at(10 + i / 100), float(i))
    assert meter.percentile_ms(50, at(11)) == 50
    assert meter.percentile_ms(95, at(11)) == 95
    assert meter.percentile_ms(99, at(11)) == 99
    assert meter.percentiles_ms((50, 95, 99), at(11)) == [50, 95, 99]
    assert meter.percentile_ms(95, at(17)) is None
    assert meter.percentiles_ms((50, 95), at(17)) == [None, None]


def test_meters_are_read_while_another_thread_counts() -> None:
    meter = SourceMeter("camera")
    stop = threading.Event()

    def count() -> None:
        n = 0
        while not stop.is_set():
            n += 1
            meter.came(at(n * 1e-4))

    thread = threading.Thread(target=count)
    thread.start()
    try:
        for _ in range(200):
            assert meter.health(at(1)).rate_hz >= 0
    finally:
        stop.set()
        thread.join()
    assert meter.health(at(1)).n == meter.n > 0


def test_source_meter_reports_what_it_counted() -> None:
    meter = SourceMeter("camera")
    assert meter.health(at(0)) == SourceHealth("camera", "missing")
    meter.state, meter.detail = "running", "/dev/video0"
    for i in range(31):
        meter.came(at(i / 30))
    meter.n_dropped += 2
    meter.n_reopened += 1
    health = meter.health(at(1.5))
    assert (health.state, health.n, health.n_dropped, health.n_reopened) == ("running", 31, 2, 1)
    assert health.age_s == pytest.approx(0.5)
    assert health.detail == "/dev/video0"


def test_stage_meter_counts_latency_from_exposure() -> None:
    meter = StageMeter("pose")
    meter.alive = True
    for i in range(10):
        meter.done(at(i / 10 + 0.04), at(i / 10))
    health = meter.health(at(1))
    assert health.latency_p95_ms == pytest.approx(40)
    assert health.rate_hz == pytest.approx(10, abs=0.7)
