"""Missions of flown paths: thin, near the path, and readable by another program's reader."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from pymavlink import mavwp

from companion.app.cli import main
from companion.geometry.geodesy import ned_from_geodetic
from companion.products.flight_result import FlightResult
from companion.products.report.write_results import write_results
from companion.products.run_folder import read_path
from tests.support.flights.flown import facts, messages
from tests.unit.geometry.test_thinned_path import away_m


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    result = FlightResult()
    for message in messages():
        result.take(message)
    folder = tmp_path_factory.mktemp("flights") / "square"
    write_results(folder, result, facts(), 0.1, page=False)
    return folder


@pytest.mark.parametrize("suffix", [".plan", ".waypoints"])
@pytest.mark.parametrize("back", [False, True])
def test_the_path_of_a_flight_and_the_way_back(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], suffix: str, back: bool
) -> None:
    out = tmp_path / f"way{suffix}"
    words = ["flights", "mission", run.name, "--flights", str(run.parent), "--out", str(out)]
    assert main([*words, *["--back"] * back]) == 0
    said = capsys.readouterr().out
    assert "waypoints" in said and "placed within 1.6 m" in said
    poses, origin, _ = read_path(run)
    assert origin is not None
    path = np.stack([p.world_from_camera.translation for p in poses])
    if suffix == ".plan":
        items = json.loads(out.read_text())["mission"]["items"]
        globes = [item["params"][4:] for item in items]
        assert {(item["command"], item["frame"]) for item in items} == {(16, 0)}
    else:
        loader = mavwp.MAVWPLoader()
        loader.load(str(out))
        read = [loader.wp(n) for n in range(loader.count())]
        globes = [(item.x, item.y, item.z) for item in read[1:]]  # the first is home
        assert {(item.command, item.frame) for item in read} == {(16, 0)}
    places = np.stack([ned_from_geodetic(lat, lon, high, origin) for lat, lon, high in globes])
    assert away_m(places, path) < 0.5 + 0.05 and len(places) < 30
    assert np.linalg.norm(places[0] - path[-1 if back else 0]) < 0.05
    assert np.linalg.norm(places[-1] - path[0 if back else -1]) < 0.05


def test_what_makes_no_mission_is_said(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["flights", "mission", str(run), "--out", str(tmp_path / "way.kml")]) == 2
    assert ".plan or .waypoints" in capsys.readouterr().err
    told = json.loads((run / "report.json").read_text()) | {"origin": None}
    lost = tmp_path / "lost"
    lost.mkdir()
    (lost / "report.json").write_text(json.dumps(told))
    (lost / "trajectory.tum").write_bytes((run / "trajectory.tum").read_bytes())
    assert main(["flights", "mission", str(lost), "--out", str(tmp_path / "way.plan")]) == 2
    assert "no place on the globe" in capsys.readouterr().err
    assert not (tmp_path / "way.plan").exists()
    assert main(["flights", "mission", "none", "--out", str(tmp_path / "way.plan")]) == 2
