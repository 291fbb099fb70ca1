"""Flights in other formats through the whole replay: the same pictures give the same path."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from companion.app.cli import main
from tests.support.flights.bags import write_bag
from tests.support.flights.sequences import (
    Piece,
    piece,
    write_euroc,
    write_flight_folder,
    write_kitti,
    write_posed_video,
    write_tum_rgbd,
)
from tests.support.processes.program import Run, replay_here

FAST = ["--set", "depth.enabled=false"]


def path_of(run: Run) -> list[list[str]]:
    """Places and turns, without stamps."""
    assert run.status == 0, run.stderr
    lines = (run.out / "trajectory.tum").read_text().splitlines()
    return [line.split()[1:] for line in lines if not line.startswith("#")]


def assert_near(one: list[list[str]], other: list[list[str]]) -> None:
    """These formats round their times, and what is expected of a frame depends on its time."""
    assert len(one) == len(other)
    a, b = (np.array(path, np.float64)[:, :3] for path in (one, other))
    assert np.abs(a - b).max() < 0.02 * np.ptp(b, axis=0).max()


@pytest.fixture(scope="module")
def flown() -> Piece:
    return piece(n_frames=40)


@pytest.fixture(scope="module")
def grey(flown: Piece, tmp_path_factory: pytest.TempPathFactory) -> list[list[str]]:
    """The path by our own layout."""
    place = tmp_path_factory.mktemp("grey")
    write_flight_folder(place / "flight", flown, grey=True)
    return path_of(replay_here(place / "flight", place / "out", *FAST))


@pytest.fixture(scope="module")
def ideal(flown: Piece, tmp_path_factory: pytest.TempPathFactory) -> list[list[str]]:
    """The path by our own layout, of pictures of an ideal lens."""
    place = tmp_path_factory.mktemp("ideal")
    write_flight_folder(place / "flight", flown.without_lens())
    return path_of(replay_here(place / "flight", place / "out", *FAST))


def test_euroc(grey: list[list[str]], flown: Piece, tmp_path: Path) -> None:
    write_euroc(tmp_path / "flight", flown)
    shutil.rmtree(tmp_path / "flight" / "mav0" / "imu0")  # its numbers are made up
    assert len(grey) >= 30
    assert path_of(replay_here(tmp_path / "flight", tmp_path / "out", *FAST)) == grey


def test_tum_rgbd(ideal: list[list[str]], flown: Piece, tmp_path: Path) -> None:
    write_tum_rgbd(tmp_path / "flight", flown.without_lens())
    own = tmp_path / "flight" / "camera.json"
    write_flight_folder(tmp_path / "other", flown.without_lens().part(1))
    own.write_bytes((tmp_path / "other" / "camera.json").read_bytes())
    assert_near(path_of(replay_here(tmp_path / "flight", tmp_path / "out", *FAST)), ideal)


def test_kitti(ideal: list[list[str]], flown: Piece, tmp_path: Path) -> None:
    folder = write_kitti(tmp_path / "flight", flown.without_lens())
    assert len(ideal) >= 30
    assert_near(path_of(replay_here(folder, tmp_path / "out", *FAST)), ideal)


def test_bag_with_odometry(flown: Piece, tmp_path: Path) -> None:
    """Metric and in its place, as the flight itself is with its own telemetry."""
    longer = piece(n_frames=60)
    write_bag(tmp_path / "flight", "mcap", longer)
    run = replay_here(tmp_path / "flight", tmp_path / "out", *FAST)
    path = np.array(path_of(run), np.float64)[:, :3]
    assert run.report["unit"] == "m"
    assert len(path) >= 55
    true = np.stack([pose.translation for pose in longer.truth])[-len(path) :]
    assert np.linalg.norm(path - true, axis=1).max() < 1.5


def test_imported_flight_gives_the_same_bytes(flown: Piece, tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", "ros1", flown)
    (tmp_path / "bag").rename(tmp_path / "flown.bag")
    for name in ("folder", "flight.mcap"):
        assert main(["import", str(tmp_path / "flown.bag"), "--out", str(tmp_path / name)]) == 0
    runs = [
        replay_here(tmp_path / name, tmp_path / f"out of {name}", *FAST)
        for name in ("flown.bag", "folder", "flight.mcap")
    ]
    assert len(path_of(runs[0])) >= 30
    first, *others = ((run.out / "trajectory.tum").read_bytes() for run in runs)
    assert all(other == first for other in others)


def test_images_without_times(flown: Piece, tmp_path: Path) -> None:
    """Not the very same path: what moves between frames is told by time as well."""
    write_posed_video(tmp_path / "flight", flown.without_lens())
    assert len(path_of(replay_here(tmp_path / "flight", tmp_path / "out", *FAST))) >= 30
