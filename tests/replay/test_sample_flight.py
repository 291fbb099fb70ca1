"""The sample flight, whole, through the command line, against its truth."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from companion.app.cli import main
from tests.support.autopilot.received_poses import TrueFlight
from tests.support.processes.program import Run, replay, replay_here
from tests.support.reference.scoring import Score, depth_errors, read_ply, read_tum, score

SAMPLE = Path(__file__).parents[2] / "sample" / "survey"
SHORT = ["--start", "10", "--stop", "14", "--set", "expert.depth.stride=8"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    done = replay(SAMPLE, tmp_path_factory.mktemp("sample"))
    assert done.status == 0, done.stderr
    return done


@pytest.fixture(scope="module")
def scored(run: Run) -> Score:
    truth = read_tum(SAMPLE / "truth" / "world_from_camera.tum")
    return score(read_tum(run.out / "trajectory.tum"), truth)


def test_it_is_quiet_and_says_where_the_report_is(run: Run) -> None:
    assert run.stderr == ""
    assert run.stdout.splitlines()[-1] == f"report: {run.out / 'report.html'}"


def test_nearly_every_frame_is_tracked(scored: Score) -> None:
    assert scored.tracked_share >= 0.97


def test_path_has_the_right_shape(scored: Score) -> None:
    assert scored.ate_sim3_m <= 0.25


def test_path_has_the_right_size(scored: Score) -> None:
    assert scored.scale_error <= 0.02


def test_world_is_level_and_turned_north(scored: Score) -> None:
    turn = np.arccos(np.clip((np.trace(scored.alignment.rotation) - 1) / 2, -1, 1))
    assert np.degrees(turn) < 3


def test_path_is_in_order_of_time_and_of_known_frames(run: Run) -> None:
    path = read_tum(run.out / "trajectory.tum")
    listed = np.loadtxt(SAMPLE / "frames.csv", delimiter=",", skiprows=1)[:, 1] * 1e-9
    assert (np.diff(path.t_s) > 0).all()
    assert all(np.abs(listed - t_s).min() < 1e-4 for t_s in path.t_s)


def test_poses_given_out_in_flight_are_true_when_they_are_given(run: Run) -> None:
    """By the gate of a live flight; they are never corrected afterwards, unlike the path."""
    sent, truth = read_tum(run.out / "poses_sent.tum"), TrueFlight(SAMPLE)
    assert sent.t_s[0] - truth.begin_s < 12.0
    steps_s = np.diff(sent.t_s)
    assert steps_s.min() > 0.0
    assert np.median(steps_s) < 0.04, "thirty a second, of a camera that gives ten"
    error_m = np.linalg.norm(sent.centres - truth.place(sent.t_s), axis=1)
    cosine = (np.einsum("nij,nij->n", sent.rotations, truth.rotations(sent.t_s)) - 1) / 2
    error_deg = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    print(f"{len(sent.t_s)} poses, {np.percentile(error_m, 95):.2f} m, {error_deg.max():.1f} deg")
    assert np.percentile(error_m, 95) < 1.0
    assert np.percentile(error_deg, 95) < 4.0


def test_cloud_lies_on_the_true_surface(run: Run, scored: Score) -> None:
    cloud = read_ply(run.out / "cloud.ply")
    assert cloud.dtype.names is not None
    assert {"x", "y", "z", "red", "green", "blue", "confidence"} <= set(cloud.dtype.names)
    assert len(cloud) > 20_000
    points = np.stack([cloud[axis].astype(np.float64) for axis in "xyz"], 1)
    assert np.isfinite(points).all()
    truth = read_tum(SAMPLE / "truth" / "world_from_camera.tum")
    errors = depth_errors(scored.alignment(points), SAMPLE, truth)
    assert len(errors) > 5_000
    assert (errors < 0.02).mean() >= 0.8


def test_cloud_has_the_colours_of_the_ground(run: Run) -> None:
    """Sandy: more red than blue. A swap of channels turns it round."""
    cloud = read_ply(run.out / "cloud.ply")
    assert np.median(cloud["red"]) > np.median(cloud["blue"]) + 10


def test_report_has_the_numbers(run: Run, scored: Score) -> None:
    report = run.report
    assert report["frames"] == 466
    assert report["tracked"] == len(read_tum(run.out / "trajectory.tum").t_s)
    assert report["points"] == len(read_ply(run.out / "cloud.ply"))
    assert report["keyframes"] > 5
    assert report["config"]["depth"]["enabled"] is True


def test_report_is_one_page_with_its_pictures_in_it(run: Run) -> None:
    page = (run.out / "report.html").read_text("utf-8")
    assert page.count("<img") >= 4
    sources = re.findall(r"""(?:src|href)=["']([^"']*)""", page)
    assert all(source.startswith(("data:", "#")) for source in sources)


def test_recording_is_a_recording(run: Run) -> None:
    data = (run.out / "flight.rrd").read_bytes()
    assert data[:3] == b"RRF"
    assert len(data) > 1_000_000


def test_two_runs_are_identical(tmp_path: Path) -> None:
    """Also where one is in a process that has done other things before."""
    assert replay(SAMPLE, tmp_path / "one", *SHORT).status == 0
    assert replay_here(SAMPLE, tmp_path / "two", *SHORT).status == 0
    for result in ("trajectory.tum", "cloud.ply", "poses_sent.tum"):
        one, two = ((tmp_path / name / result).read_bytes() for name in ("one", "two"))
        assert one == two
        assert len(one) > 1000


def test_results_are_those_that_are_kept_of_it(
    run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    """Other processors round otherwise, which moves the path by centimetres; see Makefile."""
    limits = "--max-apart", "0.3", "--max-cloud", "0.6"
    status = main(["compare", str(SAMPLE.parent / "reference"), str(run.out), *limits])
    assert status == 0, capsys.readouterr()
