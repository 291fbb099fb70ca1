"""Input that cannot be used: one line that says what, exit status 2, and nothing written."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.support.flights.sample_faults import make_flight
from tests.support.processes.program import refused, replay, replay_here

SAMPLE = Path(__file__).parents[2] / "sample" / "survey"


@pytest.fixture(scope="module")
def good_flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_flight(tmp_path_factory.mktemp("good") / "flight", SAMPLE, frames=range(60, 80))


@pytest.fixture
def flight(good_flight: Path, tmp_path: Path) -> Path:
    """One to spoil."""
    return Path(shutil.copytree(good_flight, tmp_path / "flight"))


def change_camera(flight: Path, **changes: Any) -> None:
    camera = json.loads((flight / "camera.json").read_text())
    camera.update(changes)
    kept = {key: value for key, value in camera.items() if value is not None}
    (flight / "camera.json").write_text(json.dumps(kept))


def test_no_such_folder(tmp_path: Path) -> None:
    line = refused(replay(tmp_path / "nowhere", tmp_path / "out"))
    assert "nowhere" in line
    assert not (tmp_path / "out").exists()


def test_folder_without_frames(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    assert "empty" in refused(replay_here(tmp_path / "empty", tmp_path / "out"))


def test_video_that_is_none(flight: Path, tmp_path: Path) -> None:
    (flight / "camera.mp4").write_bytes(b"not a video")
    assert "camera.mp4" in refused(replay_here(flight, tmp_path / "out"))


def test_list_of_frames_that_is_none(flight: Path, tmp_path: Path) -> None:
    (flight / "frames.csv").write_text("index,unix_ns\n0,soon\n")
    assert "frames.csv" in refused(replay_here(flight, tmp_path / "out"))


def test_list_of_frames_that_was_cut_is_said(flight: Path, tmp_path: Path) -> None:
    """The rest is replayed."""
    rows = (flight / "frames.csv").read_text().splitlines()
    (flight / "frames.csv").write_text("\n".join(rows[:-5]) + "\n")
    run = replay_here(flight, tmp_path / "out", "--set", "depth.enabled=false")
    assert run.status == 0
    assert "warning: frames.csv ends early: 5 frames at the end have no time" in run.stdout
    assert run.report["frames"] == 15


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"fx": None}, "fx"),
        ({"k1": None}, "k1"),
        ({"width": 800}, "800"),
        ({"distortion_model": "thin_prism"}, "thin_prism"),
        ({"body_from_camera": [[1, 0], [0, 1]]}, "body_from_camera"),
        ({"fx": "wide"}, "fx"),
    ],
)
def test_calibration(flight: Path, tmp_path: Path, changes: dict[str, Any], named: str) -> None:
    change_camera(flight, **changes)
    line = refused(replay_here(flight, tmp_path / "out"))
    assert "camera.json" in line
    assert named in line


def test_calibration_that_is_not_json(flight: Path, tmp_path: Path) -> None:
    (flight / "camera.json").write_text("{")
    assert "camera.json" in refused(replay_here(flight, tmp_path / "out"))


def test_telemetry_of_another_flight(flight: Path, tmp_path: Path) -> None:
    rows = (flight / "frames.csv").read_text().splitlines()
    day_ns = 86_400 * 10**9
    later = [f"{row.split(',')[0]},{int(row.split(',')[1]) + day_ns}" for row in rows[1:]]
    (flight / "frames.csv").write_text("\n".join([rows[0], *later]) + "\n")
    assert "telemetry.tlog" in refused(replay_here(flight, tmp_path / "out"))


def test_no_such_device(flight: Path, tmp_path: Path) -> None:
    line = refused(replay_here(flight, tmp_path / "out", "--set", "opencl.device=no-such-device"))
    assert "no-such-device" in line


def test_part_after_the_end(flight: Path, tmp_path: Path) -> None:
    assert "--start" in refused(replay_here(flight, tmp_path / "out", "--start", "100"))


def test_unknown_key(flight: Path, tmp_path: Path) -> None:
    line = refused(replay_here(flight, tmp_path / "out", "--set", "depth.enable=true"))
    assert "depth.enabled" in line


def test_a_flight_in_which_nothing_is_placed(tmp_path: Path) -> None:
    """One picture is no map; the report says what there was."""
    flight = make_flight(tmp_path / "flight", SAMPLE, frames=range(60, 61))
    assert "none of the pictures could be placed" in refused(replay_here(flight, tmp_path / "out"))
    assert (tmp_path / "out" / "report.html").exists()
