"""Faults injected into one flight: it goes on, and the report shows them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.flights.sample_faults import TIMESYNC, Image, Record, make_flight
from tests.support.processes.program import Run, replay_here
from tests.support.reference.scoring import Score, Trajectory, read_tum, score

SAMPLE = Path(__file__).parents[2] / "sample" / "survey"
TRUTH = read_tum(SAMPLE / "truth" / "world_from_camera.tum")
FRAMES = range(60, 180)
"""12 seconds of the sample, by number there; below, frames are counted from the first of these."""
FAULTY = range(60, 80)
SPARSE = ["--set", "depth.enabled=false"]


def fly(folder: Path, frames: range = FRAMES, **faults: Any) -> Run:
    flight = make_flight(folder / "flight", SAMPLE, frames=frames, **faults)
    run = replay_here(flight, folder / "out", *SPARSE)
    assert run.status == 0, run.stderr
    return run


def path(run: Run, without: range = range(0)) -> Trajectory:
    """What was tracked, but for some frames."""
    found = read_tum(run.out / "trajectory.tum")
    left_out = TRUTH.t_s[[FRAMES.start + number for number in without]]
    kept = np.array([not (np.abs(left_out - t_s) < 1e-3).any() for t_s in found.t_s])
    return Trajectory(found.t_s[kept], found.centres[kept], found.rotations[kept])


def scored(found: Trajectory) -> Score:
    return score(found, TRUTH)


def warned(run: Run) -> str:
    return " ".join(warning["what"] for warning in run.report["warnings"])


def test_two_seconds_of_frames_lost(tmp_path: Path) -> None:
    run = fly(tmp_path, missing=FAULTY)
    found = path(run)
    assert run.report["frames"] == len(FRAMES) - len(FAULTY)
    assert len(found.t_s) >= 0.85 * (len(FRAMES) - len(FAULTY))
    assert scored(found).ate_sim3_m <= 0.3
    assert "frames" in warned(run)


def test_two_seconds_of_white(tmp_path: Path) -> None:
    def blinded(number: int, image: Image) -> Image:
        return np.full_like(image, 255) if number in FAULTY else image

    run = fly(tmp_path, edit=blinded)
    found = path(run)
    assert len(found.t_s) <= len(FRAMES) - len(FAULTY) + 2, "white shows no place"
    assert len(found.t_s) >= 0.85 * (len(FRAMES) - len(FAULTY))
    assert scored(found).ate_sim3_m <= 0.3
    states = run.report["states"]
    assert states.get("dead reckoning", 0) + states.get("lost", 0) >= len(FAULTY) - 2


def test_two_seconds_of_the_same_image(tmp_path: Path) -> None:
    frozen: dict[str, Image] = {}

    def stuck(number: int, image: Image) -> Image:
        return frozen.setdefault("image", image) if number in FAULTY else image

    run = fly(tmp_path, edit=stuck)
    found = path(run, without=FAULTY)
    assert len(found.t_s) >= 0.85 * (len(FRAMES) - len(FAULTY))
    assert scored(found).ate_sim3_m <= 0.4
    assert "image" in warned(run)


def test_telemetry_stops_for_five_seconds(tmp_path: Path) -> None:
    run = fly(tmp_path, keep=lambda record, after_s: not 5 < after_s < 10)
    found = path(run)
    assert len(found.t_s) >= 0.97 * len(FRAMES)
    assert scored(found).ate_sim3_m <= 0.2
    assert scored(found).scale_error <= 0.05
    assert "telemetry" in warned(run)


def test_clocks_without_timesync(tmp_path: Path) -> None:
    def other(record: Record, after_s: float) -> bool:
        return record.message_id != TIMESYNC

    run = fly(tmp_path, keep=other)
    assert run.report["clock"]["method"] != "TIMESYNC"
    assert len(path(run).t_s) >= 0.97 * len(FRAMES)
    assert scored(path(run)).scale_error <= 0.05


def test_no_telemetry_means_no_scale(tmp_path: Path) -> None:
    frames = FRAMES[:80]
    run = fly(tmp_path, frames, keep=lambda record, after_s: False)
    assert len(path(run).t_s) >= 0.9 * len(frames)
    assert scored(path(run)).ate_sim3_m <= 0.3
    assert run.report["metres_per_unit"] is None
    assert "telemetry" in warned(run)


def test_part_of_a_flight(tmp_path: Path) -> None:
    run = replay_here(SAMPLE, tmp_path / "out", *SPARSE, "--start", "5", "--stop", "9")
    assert run.status == 0, run.stderr
    assert run.report["frames"] == 40
    found = read_tum(tmp_path / "out" / "trajectory.tum")
    assert found.t_s[0] - TRUTH.t_s[0] == pytest.approx(5, abs=0.11)
