import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from companion.app.cli import main
from companion.geometry.transforms import Pose
from companion.messages import PointChunk, Track
from companion.products.flight_result import FlightResult
from companion.products.report.write_results import write_results
from tests.support.flights.flown import facts, messages


def run(folder: Path, shift: float = 0.0, n_missing: int = 0, **changes: object) -> Path:
    """A finished run, its camera and its cloud off by `shift` map units."""
    result = FlightResult()
    missing = n_missing
    for message in messages():
        if isinstance(message, Track) and message.keyframe_from_camera is not None:
            if missing:
                missing -= 1
                continue
            here = message.keyframe_from_camera
            moved = Pose(here.rotation, here.translation + [0, 0, shift])
            message = Track(
                message.seq, message.t_ns, message.state, message.map_from_camera,
                message.keyframe_id, moved,
            )  # fmt: skip
        if isinstance(message, PointChunk):
            points = message.points_camera + np.float32(shift)
            message = replace(message, points_camera=points)
        result.take(message)
    write_results(folder, result, facts(**changes), 0.1, page=False)
    return folder


def compared(*words: object) -> int:
    return main(["compare", *map(str, words)])


def test_a_run_is_the_same_as_itself(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a = run(tmp_path / "a")
    b = Path(shutil.copytree(a, tmp_path / "b"))
    assert compared(a, b, "--out", tmp_path / "out", "--max-apart", 0, "--max-cloud", 0) == 0
    assert "the same to the last bit" in capsys.readouterr().out
    assert "the same to the last bit" in (tmp_path / "out" / "compare.html").read_text()
    told = json.loads((tmp_path / "out" / "compare.json").read_text())
    assert told["identical"] and told["poses"]["turned_deg_max"] == 0
    assert told["poses"]["rms"] == told["cloud"]["a_to_b"]["max"] == 0


def test_what_differs_is_measured_and_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a = run(tmp_path / "a")
    b = run(tmp_path / "b", 0.05, versions={"companion": "0.2.0", "numpy": "2.0"})
    assert compared(a, b, "--out", tmp_path / "out") == 0
    told = json.loads((tmp_path / "out" / "compare.json").read_text())
    scale = told["poses"]["rms"] / 0.05  # metres in a map unit
    report = json.loads((a / "report.json").read_text())
    assert scale == pytest.approx(report["metres_per_unit"], rel=1e-3)
    assert told["poses"]["turned_deg_max"] < 1e-3
    assert 0 < told["cloud"]["a_to_b"]["p50"] <= 2 * told["poses"]["rms"]
    assert told["versions"] == {"companion": ["0.1.0", "0.2.0"]}
    assert "trajectory.tum: differs" in capsys.readouterr().out
    page = (tmp_path / "out" / "compare.html").read_text()
    assert page.count("<svg") == 2


def test_settings_of_the_version_before_are_compared_by_their_keys_now(tmp_path: Path) -> None:
    a, b = run(tmp_path / "a"), run(tmp_path / "b")
    for folder, settings in (
        (a, {"camera": {"gain": 3}, "mapping": {"window": 5, "n_fixed": 10}}),
        (b, {"camera": {}, "expert": {"camera": {"gain": 3}}, "depth": {"stride": 1}}),
    ):
        report = json.loads((folder / "report.json").read_text())
        (folder / "report.json").write_text(json.dumps(report | {"config": settings}))
    assert compared(a, b, "--out", tmp_path / "out") == 0
    told = json.loads((tmp_path / "out" / "compare.json").read_text())
    assert told["config"] == {"expert.depth.stride": [None, 1], "mapping.window": [5, None]}


def test_limits_that_are_not_kept_fail(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a, b = run(tmp_path / "a"), run(tmp_path / "b", 0.05)
    assert compared(a, b, "--max-apart", 1, "--max-cloud", 1) == 0
    assert compared(a, b, "--max-apart", 1e-4) == 1
    assert "poses are" in capsys.readouterr().err
    assert compared(a, b, "--max-cloud", 1e-4) == 1
    assert "cloud from A to B" in capsys.readouterr().err
    fewer = run(tmp_path / "fewer", n_missing=5)
    assert compared(a, fewer, "--max-apart", 1) == 1
    assert "5 frames fewer" in capsys.readouterr().err


def test_what_is_no_run_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a = run(tmp_path / "a")
    (tmp_path / "empty").mkdir()
    for other in ("missing", "empty"):
        assert compared(a, tmp_path / other) == 2
        assert other in capsys.readouterr().err


def test_runs_of_two_flights_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a, b = run(tmp_path / "a"), run(tmp_path / "b")
    path = b / "trajectory.tum"
    path.write_text(path.read_text().replace("\n17", "\n18"))
    assert compared(a, b) == 2
    assert "no frame in common" in capsys.readouterr().err
