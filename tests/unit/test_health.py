from __future__ import annotations

import dataclasses
import json
import math
import threading

import pytest

from companion.health import (
    ComputerLoad,
    FeedbackHealth,
    Health,
    LatencyMeter,
    RateMeter,
    SourceHealth,
    SourceMeter,
    StageHealth,
    StageMeter,
    StatusLines,
)

S = 1_000_000_000
EPOCH_NS = 1_790_000_000 * S


def at(t_s: float) -> int:
    return EPOCH_NS + round(t_s * S)


FLYING = Health(
    t_ns=at(100),
    sources=(
        SourceHealth("camera", "running", 29.9, 3000, 12, 0, 0.02),
        SourceHealth("autopilot", "running", 61.4, 6000, 0, 1, 0.01, "ArduPilot"),
    ),
    stages=(StageHealth("pose", True, 29.9, 31.0, 41.4, 2990),),
    tracker="tracking",
    quality=84,
    scale="from the autopilot's positions",
    pose_latency_p95_ms=41.4,
    feedback=FeedbackHealth("odometry", True, rate_hz=30.1),
    flight="2026-11-21-101500",
    load=ComputerLoad(
        cpu_share=0.634,
        temperatures_c={"cpu": 71.2, "gpu": 65.0},
        memory_used_mib=2048,
        memory_total_mib=8192,
        disk_free_mib=12.5 * 1024,
    ),
)


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


def test_line_is_one_short_line() -> None:
    assert FLYING.line() == (
        "tracking, quality 84, 41 ms; feedback 30/s; camera 30/s (12 dropped); autopilot 61/s;"
        " cpu 63 %, memory 25 %, 71 C, disk 12.5 GiB free; flight 2026-11-21-101500"
    )


def test_line_names_what_is_amiss() -> None:
    ill = dataclasses.replace(
        FLYING,
        sources=(
            SourceHealth("camera", "missing", detail="unplugged"),
            SourceHealth("autopilot", "silent", age_s=4.4),
        ),
        stages=(StageHealth("dense", False, detail="killed"), StageHealth("pose", n_restarted=1)),
        tracker="lost",
        quality=-1,
        scale="",
        feedback=FeedbackHealth("odometry", False, "no metric scale", "3.1 m travelled"),
        degraded="viewer off, the processor is hot",
        flight="",
        load=ComputerLoad(),
        pose_latency_p95_ms=None,
    )
    assert ill.line() == (
        "lost, no scale; no feedback: no metric scale (3.1 m travelled); camera missing"
        " (unplugged); autopilot silent for 4 s; dense down (killed); pose restarted 1 x;"
        " reduced: viewer off, the processor is hot; no flight"
    )


def test_a_daemon_that_just_started_has_a_line() -> None:
    assert Health(at(0)).line() == "waiting for the camera, no scale; feedback off; no flight"


def test_json_has_no_numbers_that_json_lacks() -> None:
    health = dataclasses.replace(
        FLYING,
        sources=(SourceHealth("camera", rate_hz=math.nan, age_s=math.inf),),
        n_warnings={"frames are missing": 3},
    )
    document = json.loads(json.dumps(health.to_json(), allow_nan=False))
    assert document["sources"][0]["rate_hz"] is None
    assert document["sources"][0]["age_s"] is None
    assert document["load"]["temperature_c"] == 71.2
    assert document["load"]["memory_share"] == 0.25
    assert document["feedback"]["sending"] is True
    assert document["n_warnings"] == {"frames are missing": 3}
    assert document["t_ns"] == FLYING.t_ns
    assert document["line"] == health.line()


@pytest.mark.parametrize(
    "change",
    [
        {"tracker": "lost"},
        {"scale": ""},
        {"flight": ""},
        {"degradation": 1},
        {"sources": FLYING.sources[:1]},
        {"feedback": FeedbackHealth("odometry", False, "lost")},
        {"stages": (StageHealth("pose", True, n_restarted=1),)},
    ],
)
def test_changes_worth_a_line(change: dict[str, object]) -> None:
    assert dataclasses.replace(FLYING, **change).key() != FLYING.key()  # type: ignore[arg-type]


def test_numbers_that_move_are_no_change() -> None:
    later = dataclasses.replace(
        FLYING,
        t_ns=at(101),
        quality=70,
        sources=tuple(dataclasses.replace(s, rate_hz=28.0, n=9999) for s in FLYING.sources),
        feedback=dataclasses.replace(FLYING.feedback, rate_hz=29.0, detail="0.31 m"),
    )
    assert later.key() == FLYING.key()


def test_lines_come_every_so_often_and_at_once_on_a_change() -> None:
    lines = StatusLines(every_s=10)
    said = []
    for i in range(250):
        t_s = i / 10
        tracker = "lost" if 13 <= t_s < 14.5 else "tracking"
        if lines.step(dataclasses.replace(FLYING, t_ns=at(t_s), tracker=tracker)) is not None:
            said.append(t_s)
    assert said == pytest.approx([0, 10, 13, 14.5, 24.5])


def test_what_flaps_does_not_fill_the_journal() -> None:
    lines = StatusLines(every_s=10)
    said = 0
    for i in range(1000):
        tracker = "lost" if i % 2 else "tracking"
        step = lines.step(dataclasses.replace(FLYING, t_ns=at(i / 100), tracker=tracker))
        said += step is not None
    assert 5 <= said <= 11
