"""A EuRoC folder with cam0 and cam1: depths beside its telemetry."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from companion.config import CameraConfig, TelemetryConfig
from companion.geometry.camera import Camera
from companion.messages import Frame
from companion.telemetry import DepthSample
from drivers.datasets.euroc import open_euroc
from drivers.telemetry.measured_depths import OFF_LINE
from drivers.telemetry.telemetry_log import TelemetryLog
from tests.support.flights.rendered_flight import CAMERA_DOWN
from tests.support.flights.sequences import Piece, write_euroc, write_euroc_camera
from tests.support.flights.stereo_flight import (
    FIRST,
    SECOND,
    ground,
    ned_from_body,
    pictures_of,
    with_baseline,
)
from tests.support.processes.program import replay_here
from tests.support.reference.scoring import read_tum, score

RATE_HZ = 10.0


def write_pair(folder: Path, seconds: float) -> None:
    frames, poses = [], []
    for seq, (t_ns, pose, grey) in enumerate(pictures_of(FIRST, ground(), seconds, RATE_HZ, 0)):
        frames.append(Frame(seq, t_ns, grey, np.repeat(grey[..., None], 3, 2)))
        poses.append(pose)
    write_euroc(folder, Piece(frames, poses, FIRST, []))
    write_second(folder, SECOND, seconds)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("euroc")
    write_pair(folder, seconds=1.0)
    return folder


def write_second(folder: Path, stated: Camera, seconds: float = 1.0, late_ns: int = 0) -> None:
    found = pictures_of(SECOND, ground(), seconds, RATE_HZ, 1)
    frames = [
        Frame(seq, t_ns + late_ns, grey, np.repeat(grey[..., None], 3, 2))
        for seq, (t_ns, _, grey) in enumerate(found)
    ]
    shutil.rmtree(folder / "mav0" / "cam1", ignore_errors=True)
    write_euroc_camera(folder / "mav0" / "cam1", frames, stated)


def read(folder: Path, telemetry: TelemetryConfig | None = None) -> TelemetryLog:
    return open_euroc(folder, CameraConfig(), telemetry or TelemetryConfig()).telemetry()


def depths_in(log: TelemetryLog) -> list[DepthSample]:
    return [sample for sample in log.samples if isinstance(sample, DepthSample)]


def whats(log: TelemetryLog) -> list[str]:
    return [warned.what for warned in log.warnings]


def test_both_cameras_give_depths(written: Path) -> None:
    flight = open_euroc(written, CameraConfig(), TelemetryConfig())
    log = flight.telemetry()
    depths = depths_in(log)
    times_ns = sorted({sample.t_ns for sample in depths})
    assert times_ns == [flight.times_ns[k] for k in (0, 3, 6, 9)]
    assert np.median([sample.depth_m for sample in depths]) == pytest.approx(7.0, rel=0.01)
    assert [s.t_ns for s in log.samples] == sorted(s.t_ns for s in log.samples)
    assert not whats(log)


def test_depths_that_are_not_believed_are_not_made(written: Path) -> None:
    assert not depths_in(read(written, TelemetryConfig(use=("attitude", "imu"))))


def test_a_shift_of_the_log_does_not_part_depths_from_their_pictures(written: Path) -> None:
    flight = open_euroc(written, CameraConfig(), TelemetryConfig(offset_s=0.25))
    assert {s.t_ns for s in depths_in(flight.telemetry())} <= set(flight.times_ns)


@pytest.fixture
def copied(written: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written, tmp_path / "flight"))


def test_pictures_of_other_times_are_told(copied: Path) -> None:
    write_second(copied, SECOND, late_ns=20_000_000)
    log = read(copied)
    assert not depths_in(log)
    assert whats(log) == ["no picture of cam1 is of the time of one of the camera's"]


def test_a_second_camera_that_looks_elsewhere_is_told(copied: Path) -> None:
    write_second(copied, replace(with_baseline(0.0)))
    log = read(copied)
    assert not depths_in(log)
    assert whats(log) == ["cam1 is not used"]


def test_a_calibration_that_does_not_fit_is_told(copied: Path) -> None:
    write_second(copied, replace(SECOND, cy=SECOND.cy + 1.0))
    assert whats(read(copied)) == [OFF_LINE]


def test_damaged_pictures_are_told(copied: Path) -> None:
    for file in (copied / "mav0" / "cam1" / "data").iterdir():
        file.write_bytes(b"no picture")
    log = read(copied)
    assert not depths_in(log)
    assert whats(log)[0] == "pictures of cam1 could not be read"


def test_a_replay_of_two_cameras_alone_is_metric(tmp_path: Path) -> None:
    folder = tmp_path / "flight"
    write_pair(folder, seconds=8.0)
    shutil.rmtree(folder / "mav0" / "imu0")
    run = replay_here(folder, tmp_path / "out", "--set", "depth.enabled=false")
    assert run.status == 0, run.stderr
    assert run.report["unit"] == "m"
    assert run.report["scale"]["method"] == "measured depths"
    states = np.loadtxt(folder / "mav0" / "state_groundtruth_estimate0" / "data.csv", delimiter=",")
    found = read_tum(run.out / "trajectory.tum")
    poses = [ned_from_body((t - states[0, 0]) * 1e-9) @ CAMERA_DOWN for t in states[:, 0]]
    truth = type(found)(
        states[:, 0] * 1e-9, np.stack([p.translation for p in poses]),
        np.stack([p.rotation for p in poses]),
    )  # fmt: skip
    scored = score(found, truth)
    print(f"{100 * scored.scale_error:.2f} % off")
    assert scored.tracked_share > 0.9
    assert scored.scale_error < 0.01
