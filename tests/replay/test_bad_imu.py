"""The sample flight by its IMU alone, where that is wrong: no wrong metre is given out."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.estimation.inertial.imu_verdict import NOT_USED
from tests.support.flights.altered_imu import Alter, late, saturated, turned_about_z, with_imu
from tests.support.processes.program import Run, replay_here
from tests.support.reference.scoring import read_tum, score

SAMPLE = Path(__file__).parents[2] / "sample" / "survey"
TRUTH = read_tum(SAMPLE / "truth" / "world_from_camera.tum")
BY_IMU = 'telemetry.use=["attitude","imu"]'
FAILS_S = 22.0
"""By then poses have been given out for six seconds."""


def flown(folder: Path, alter: Alter, stop_s: float) -> Run:
    flight = with_imu(folder / "flight", SAMPLE, alter)
    run = replay_here(
        flight, folder / "out", "--set", BY_IMU, "--set", "depth.enabled=false",
        f"--stop={stop_s}",
    )  # fmt: skip
    assert run.status == 0, run.stderr
    return run


def why_not(run: Run) -> str:
    (found,) = [each["first_detail"] for each in run.report["warnings"] if each["what"] == NOT_USED]
    return str(found)


@pytest.mark.parametrize(
    ("alter", "words"),
    [(turned_about_z, "turned by 90 degrees about"), (late(0.3), "ms late")],
)
def test_nothing_is_sent_by_one_that_is_wrong(tmp_path: Path, alter: Alter, words: str) -> None:
    run = flown(tmp_path, alter, FAILS_S)
    assert words in why_not(run)
    assert run.report["scale"] is None
    assert run.n_sent == 0
    assert run.report["tracked_share"] > 0.9


def test_what_was_sent_before_it_was_saturated_is_metric(tmp_path: Path) -> None:
    run = flown(tmp_path, saturated(19.6133, FAILS_S), FAILS_S + 8.0)
    assert "saturated: its z axis ends at" in why_not(run)
    assert run.n_sent > 100
    found = score(read_tum(run.out / "poses_sent.tum"), TRUTH)
    assert found.n_common > 20
    assert found.scale_error < 0.05
