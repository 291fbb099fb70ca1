"""The sample flight's first seconds with less believed of its telemetry (`telemetry.use`)."""

from __future__ import annotations

import html
from pathlib import Path

import pytest

from companion.config import MEASUREMENTS
from tests.support.processes.program import Run, replay_here

SAMPLE = Path(__file__).parents[2] / "sample" / "survey"
METRIC_S = 14
"""As long as `sample_begun`."""


def believing(out: Path, *words: str) -> Run:
    options = "--set", "depth.enabled=false", "--set", f"telemetry.use={list(words)}"
    run = replay_here(SAMPLE, out, "--stop", str(METRIC_S), *options)
    assert run.status == 0, run.stderr
    return run


@pytest.fixture
def everything(sample_begun: Run) -> Run:
    return sample_begun


def test_everything_is_believed_and_nothing_said_of_it(everything: Run) -> None:
    assert everything.report["believed"] == list(MEASUREMENTS)
    assert "telemetry.use" not in everything.stdout
    assert "is believed" not in (everything.out / "report.html").read_text("utf-8")
    assert everything.n_sent > 100


def test_each_source_of_positions_is_believed_by_itself(everything: Run, tmp_path: Path) -> None:
    run = believing(tmp_path, "attitude", "satellites")
    assert everything.report["scale"]["method"] == "local position and velocity and accelerometers"
    assert run.report["scale"]["method"] == "GPS and velocity"
    assert run.report["believed"] == ["attitude", "satellites"]
    # what came is in the report, and is not what decided
    assert run.report["rates_hz"] == everything.report["rates_hz"]
    told = "f the autopilot's telemetry only attitude, satellites is believed (telemetry.use)"
    assert f"telemetry: o{told}\n" in run.stdout
    page = html.unescape((run.out / "report.html").read_text("utf-8"))
    assert f"O{told}." in page


def test_attitude_alone_claims_no_scale(tmp_path: Path) -> None:
    run = believing(tmp_path, "attitude")
    assert run.report["tracked_share"] > 0.9
    assert run.report["scale"] is None and run.report["metres_per_unit"] is None
    assert run.report["unit"] == "map units" and run.report["origin"] is None
    assert "No metric scale was found" in (run.out / "report.html").read_text("utf-8")
    assert run.n_sent == 0


def test_without_attitude_no_pose_is_sent(everything: Run, tmp_path: Path) -> None:
    """Metric it may be: the tilt of a pose cannot be checked."""
    run = believing(tmp_path, *(word for word in MEASUREMENTS if word != "attitude"))
    assert run.report["tracked_share"] > 0.9
    assert run.n_sent == 0
    assert "is believed (telemetry.use): without attitude no pose is sent\n" in run.stdout
