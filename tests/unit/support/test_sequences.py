"""Data sets in other formats, written from the sample flight and read back."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from companion.config import CameraConfig
from companion.errors import FlightError
from companion.geometry.camera import Distortion
from companion.geometry.transforms import Array, Pose
from companion.messages import Frame, Warned
from companion.telemetry import ImuSample
from drivers.flight import Flight, TruePose
from drivers.open_flight import format_of, open_flight
from tests.support.flights.sequences import (
    Piece,
    piece,
    write_euroc,
    write_kitti,
    write_posed_video,
    write_remode,
    write_tum_rgbd,
)


@pytest.fixture(scope="module")
def flown() -> Piece:
    return piece().part(6)


def opened(path: Path) -> Flight:
    return open_flight(path, CameraConfig())


def whats(warnings: Sequence[Warned]) -> list[str]:
    return [warned.what for warned in warnings]


def pictures(flight: Flight) -> list[Frame]:
    found = list(flight.frames())
    assert all(isinstance(item, Frame) for item in found)
    return [item for item in found if isinstance(item, Frame)]


def same_grey(flight: Flight, flown: Piece) -> bool:
    found = pictures(flight)
    assert len(found) == len(flown.frames)
    return all((a.grey == b.grey).all() for a, b in zip(found, flown.frames, strict=True))


def same_rgb(flight: Flight, flown: Piece) -> bool:
    return all((a.rgb == b.rgb).all() for a, b in zip(pictures(flight), flown.frames, strict=True))


def steps(poses: Sequence[Pose]) -> list[Array]:
    """From each camera to the next: what stays the same whatever the world's axes are."""
    return [(a.inverse() @ b).matrix() for a, b in pairwise(poses)]


def assert_true(found: Sequence[TruePose], flown: Piece) -> None:
    assert len(found) == len(flown.truth)
    poses = [each.world_from_camera for each in found]
    np.testing.assert_allclose(steps(poses), steps(flown.truth), atol=2e-6)


def test_euroc(tmp_path: Path, flown: Piece) -> None:
    write_euroc(tmp_path, flown)
    flight = opened(tmp_path)
    assert format_of(tmp_path).name == "EuRoC (ASL)"
    assert flight.times_ns == tuple(f.t_ns for f in flown.frames)
    assert same_grey(flight, flown)
    camera, wanted = flight.camera, flown.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (
        wanted.fx, wanted.fy, wanted.cx, wanted.cy,
    )  # fmt: skip
    assert camera.distortion is Distortion.RADTAN
    assert camera.coefficients == wanted.coefficients
    assert camera.body_from_camera is not None
    assert wanted.body_from_camera is not None
    np.testing.assert_allclose(
        camera.body_from_camera.matrix(), wanted.body_from_camera.matrix(), atol=1e-9
    )
    assert_true(flight.truth(), flown)
    assert flight.warnings == ()


def test_imu_of_euroc(tmp_path: Path, flown: Piece) -> None:
    write_euroc(tmp_path, flown)
    log = opened(tmp_path).telemetry()
    _, second, *_ = (s for s in log.samples if isinstance(s, ImuSample))
    assert second.t_ns == flown.frames[0].t_ns + 5_000_000
    assert second.gyro_rad_s.tolist() == [0.01, -0.2, 0.3]
    assert second.accel_m_s2.tolist() == [9.25, 0.5, -3.125]
    assert log.rates_hz == {"attitude": 200, "imu": 200}


def test_tum_rgbd(tmp_path: Path, flown: Piece) -> None:
    folder = tmp_path / "rgbd_dataset_freiburg2_desk"
    write_tum_rgbd(folder, flown)
    flight = opened(folder)
    assert format_of(folder).name == "TUM RGB-D"
    np.testing.assert_allclose(flight.times_ns, [f.t_ns for f in flown.frames], atol=1000)
    assert same_rgb(flight, flown)
    assert (flight.camera.fx, flight.camera.coefficients[0]) == (520.9, 0.2312)
    assert not flight.camera.assumed
    assert_true(flight.truth(), flown)
    assert whats(flight.telemetry().warnings) == ["no telemetry"]


def test_tum_rgbd_of_an_unknown_camera(tmp_path: Path, flown: Piece) -> None:
    write_tum_rgbd(tmp_path / "mine", flown)
    assert opened(tmp_path / "mine").camera.assumed


def test_kitti(tmp_path: Path, flown: Piece) -> None:
    folder = write_kitti(tmp_path, flown)
    flight = opened(folder)
    assert format_of(folder).name == "KITTI odometry"
    after_ns = np.array([f.t_ns - flown.frames[0].t_ns for f in flown.frames])
    np.testing.assert_allclose(flight.times_ns, after_ns, atol=1000)
    assert same_rgb(flight, flown)
    assert flight.camera.distortion is Distortion.NONE
    assert flight.camera.fy == pytest.approx(flown.camera.fy, rel=1e-9)
    assert_true(flight.truth(), flown)


def test_remode(tmp_path: Path, flown: Piece) -> None:
    write_remode(tmp_path, flown)
    flight = opened(tmp_path)
    assert flight.times_ns[:2] == (0, 100_000_000)
    assert same_grey(flight, flown)
    assert_true(flight.truth(), flown)
    assert whats(flight.warnings) == ["no times: images are taken to come at 10/s"]


def test_images_with_poses(tmp_path: Path, flown: Piece) -> None:
    write_posed_video(tmp_path, flown)
    flight = opened(tmp_path)
    assert format_of(tmp_path).name == "images with poses"
    assert same_rgb(flight, flown)
    assert flight.camera.cx == flown.camera.cx
    assert_true(flight.truth(), flown)


def test_images_with_a_matrix_only(tmp_path: Path, flown: Piece) -> None:
    write_posed_video(tmp_path, flown)
    (tmp_path / "poses.txt").unlink()
    flight = opened(tmp_path)
    assert flight.camera.fy == flown.camera.fy
    assert flight.truth() == ()


def test_missing_image_leaves_a_hole(tmp_path: Path, flown: Piece) -> None:
    write_euroc(tmp_path, flown)
    (tmp_path / "mav0" / "cam0" / "data" / f"{flown.frames[2].t_ns}.png").unlink()
    flight = opened(tmp_path)
    assert whats(flight.warnings) == ["images of the list are missing"]
    found = list(flight.frames())
    assert isinstance(found[2], Warned)
    assert [f.seq for f in found if isinstance(f, Frame)] == [0, 1, 3, 4, 5]


@pytest.mark.parametrize(
    ("file", "old", "new", "named"),
    [
        ("mav0/cam0/sensor.yaml", "pinhole", "omni", "camera_model"),
        ("mav0/cam0/sensor.yaml", "radial-tangential", "thin", "distortion_model"),
        ("mav0/cam0/sensor.yaml", "[640, 480]", "[752, 480]", "752"),
        ("mav0/cam0/sensor.yaml", "T_BS", "T_BS: [", "YAML"),
        ("mav0/cam0/sensor.yaml", "intrinsics: [", "intrinsics: [1, ", "intrinsics"),
        ("mav0/cam0/data.csv", "17952", "x", "data.csv"),
    ],
)
def test_euroc_that_is_damaged(
    tmp_path: Path, flown: Piece, file: str, old: str, new: str, named: str
) -> None:
    write_euroc(tmp_path, flown.part(2))
    text = (tmp_path / file).read_text()
    assert old in text
    (tmp_path / file).write_text(text.replace(old, new))
    with pytest.raises(FlightError, match=named):
        opened(tmp_path)


def test_kitti_that_is_damaged(tmp_path: Path, flown: Piece) -> None:
    folder = write_kitti(tmp_path, flown.part(3))
    (folder / "times.txt").write_text("0.0\n0.1\n")
    assert "times.txt and the images differ in number" in whats(opened(folder).warnings)
    (folder / "calib.txt").write_text("P0: 1 2 3\n")
    with pytest.raises(FlightError, match="P2"):
        opened(folder)
