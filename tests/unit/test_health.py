"""Health in words and as a document."""

from __future__ import annotations

import dataclasses
import json
import math

import pytest

from companion.health import ComputerLoad, FeedbackHealth, Health, SourceHealth, StageHealth
from companion.status_lines import StatusLines, change_key, line_of

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


def test_line_is_one_short_line() -> None:
    assert line_of(FLYING) == (
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
    assert line_of(ill) == (
        "lost, no scale; no feedback: no metric scale (3.1 m travelled); camera missing"
        " (unplugged); autopilot silent for 4 s; dense down (killed); pose restarted 1 x;"
        " reduced: viewer off, the processor is hot; no flight"
    )


def test_a_daemon_that_just_started_has_a_line() -> None:
    assert line_of(Health(at(0))) == "waiting for the camera, no scale; feedback off; no flight"


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
    assert change_key(dataclasses.replace(FLYING, **change)) != change_key(FLYING)  # type: ignore[arg-type]


def test_numbers_that_move_are_no_change() -> None:
    later = dataclasses.replace(
        FLYING,
        t_ns=at(101),
        quality=70,
        sources=tuple(dataclasses.replace(s, rate_hz=28.0, n=9999) for s in FLYING.sources),
        feedback=dataclasses.replace(FLYING.feedback, rate_hz=29.0, detail="0.31 m"),
    )
    assert change_key(later) == change_key(FLYING)


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
