"""The sample flight's first seconds with less believed of its telemetry (`telemetry.use`)."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.config import MEASUREMENTS
from tests.support.processes.program import Run, replay_here

SAMPLE = Path(__file__).parents[2] / "sample" / "survey"
METRIC_S = 14
"""Time in which the flight gets its scale by positions, and poses are proven."""
SENT = "poses_sent.tum"


def replayed(out: Path, *words: str) -> Run:
    use = [] if words == ("everything",) else ["--set", f"telemetry.use={list(words)}"]
    run = replay_here(
        SAMPLE, out, "--stop", str(METRIC_S), "--set", "depth.enabled=false", *use
    )  # fmt: skip
    assert run.status == 0, run.stderr
    return run


@pytest.fixture(scope="module")
def everything(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return replayed(tmp_path_factory.mktemp("everything"), "everything")


def test_all_words_are_as_none(everything: Run, tmp_path: Path) -> None:
    run = replayed(tmp_path, *MEASUREMENTS)
    for name in ("trajectory.tum", SENT):
        assert (run.out / name).read_bytes() == (everything.out / name).read_bytes()
    assert everything.report["believed"] == list(MEASUREMENTS)
    for done in (run, everything):
        assert "telemetry.use" not in done.stdout
        assert "is believed" not in (done.out / "report.html").read_text("utf-8")
    assert (everything.out / SENT).stat().st_size > 1000


def test_positions_that_are_not_believed_give_no_place(everything: Run, tmp_path: Path) -> None:
    run = replayed(tmp_path, "attitude", "range", "height")
    assert everything.report["scale"]["method"].startswith("local position")
    assert everything.report["origin"] is not None
    assert run.report["scale"]["method"] == "rangefinder"
    assert run.report["origin"] is None
    assert run.report["believed"] == ["attitude", "range", "height"]
    # what came is in the report, and is not what decided
    assert run.report["rates_hz"] == everything.report["rates_hz"]
    told = "of the autopilot's telemetry only attitude, range, height is believed (telemetry.use)"
    assert f"telemetry: {told}\n" in run.stdout
    page = (run.out / "report.html").read_text("utf-8")
    assert "telemetry only attitude, range, height is believed" in page


def test_attitude_alone_claims_no_scale(tmp_path: Path) -> None:
    run = replayed(tmp_path, "attitude")
    assert run.report["tracked_share"] > 0.9
    assert run.report["scale"] is None and run.report["metres_per_unit"] is None
    assert run.report["unit"] == "map units"
    assert "No metric scale was found" in (run.out / "report.html").read_text("utf-8")
    assert (run.out / SENT).read_text() == ""


def test_without_attitude_no_pose_is_sent(everything: Run, tmp_path: Path) -> None:
    """Metric it may be: the tilt of a pose cannot be checked."""
    run = replayed(tmp_path, *(word for word in MEASUREMENTS if word != "attitude"))
    assert run.report["tracked_share"] > 0.9
    assert (run.out / SENT).read_text() == ""
    assert "is believed (telemetry.use): without attitude no pose is sent\n" in run.stdout
