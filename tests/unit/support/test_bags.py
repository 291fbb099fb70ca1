"""Bags of ROS 1 and 2 with a piece of the sample flight, read back."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from companion.config import CameraConfig
from companion.errors import FlightError
from companion.geometry.geodesy import GeoOrigin
from companion.geometry.transforms import angle_between, rotation_from_quaternion
from companion.messages import Frame, Warned
from companion.telemetry import AttitudeSample, ImuSample, PositionSample, PositionSource
from drivers.datasets.bag_pictures import rgb_of
from drivers.flight import Flight
from drivers.open_flight import format_of, open_flight
from tests.support.flights.bags import CAMERA, write_bag
from tests.support.flights.sequences import Piece, piece, write_flight_folder

KINDS = ("ros1", "sqlite", "mcap")
HOME = GeoOrigin(-35.363262, 149.165237, 584.0)


@pytest.fixture(scope="module")
def flown() -> Piece:
    return piece().part(4)


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory, flown: Piece) -> dict[str, Path]:
    place = tmp_path_factory.mktemp("bags")
    for kind in KINDS:
        write_bag(place / name_of(kind), kind, flown)
    return {kind: place / name_of(kind) for kind in KINDS}


def name_of(kind: str) -> str:
    return "flight.bag" if kind == "ros1" else kind


def whats(warnings: Sequence[Warned]) -> list[str]:
    return [warned.what for warned in warnings]


def local_positions(flown: Piece) -> dict[int, PositionSample]:
    found = [s for s in flown.samples if isinstance(s, PositionSample)]
    return {s.t_ns: s for s in found if s.source is PositionSource.LOCAL}


def opened(path: Path, **camera: str) -> Flight:
    return open_flight(path, CameraConfig(**camera))  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", KINDS)
def test_pictures_and_camera(bags: dict[str, Path], flown: Piece, kind: str) -> None:
    assert format_of(bags[kind]).name == "ROS bag"
    flight = opened(bags[kind])
    assert flight.times_ns == tuple(f.t_ns for f in flown.frames)
    found = [f for f in flight.frames() if isinstance(f, Frame)]
    assert all((a.rgb == b.rgb).all() for a, b in zip(found, flown.frames, strict=True))
    later = [f.seq for f in flight.frames(flown.frames[2].t_ns) if isinstance(f, Frame)]
    assert later == [2, 3]
    wanted = flown.camera
    assert (flight.camera.fx, flight.camera.fy) == (wanted.fx, wanted.fy)
    assert (flight.camera.cx, flight.camera.cy) == (wanted.cx, wanted.cy)
    assert flight.camera.coefficients == wanted.coefficients
    assert flight.camera.body_from_camera is not None
    assert wanted.body_from_camera is not None
    np.testing.assert_allclose(
        flight.camera.body_from_camera.matrix(), wanted.body_from_camera.matrix(), atol=1e-9
    )
    assert flight.warnings == ()


@pytest.mark.parametrize("kind", KINDS)
def test_telemetry(bags: dict[str, Path], flown: Piece, kind: str) -> None:
    """World and body turned from robots' axes to ours, the IMU from its own place as well."""
    log = opened(bags[kind]).telemetry()
    position = [s for s in log.samples if isinstance(s, PositionSample)]
    true = local_positions(flown)
    assert len(position) > 10
    for sample in position:
        assert sample.source is PositionSource.LOCAL
        np.testing.assert_allclose(sample.position_ned_m, true[sample.t_ns].position_ned_m)
        assert sample.velocity_ned_m_s is not None
        velocity = true[sample.t_ns].velocity_ned_m_s
        assert velocity is not None
        np.testing.assert_allclose(sample.velocity_ned_m_s, velocity, atol=1e-9)
    imu = next(s for s in log.samples if isinstance(s, ImuSample))
    np.testing.assert_allclose(imu.accel_m_s2, [0.5, -0.25, -9.75], atol=1e-9)
    rates = next(
        s.rates_body_rad_s for s in flown.samples
        if isinstance(s, AttitudeSample) and s.t_ns == imu.t_ns
    )  # fmt: skip
    assert rates is not None
    np.testing.assert_allclose(imu.gyro_rad_s, rates, atol=1e-9)


def attitudes_agree(samples: Sequence[object], flown: Piece, within_rad: float) -> bool:
    found = [s for s in samples if isinstance(s, AttitudeSample)]
    true = [s for s in flown.samples if isinstance(s, AttitudeSample)]
    times = np.array([s.t_ns for s in true])
    assert len(found) > 10
    return all(
        angle_between(
            rotation_from_quaternion(s.ned_from_body),
            rotation_from_quaternion(true[int(np.abs(times - s.t_ns).argmin())].ned_from_body),
        ) < within_rad
        for s in found
    )  # fmt: skip


def test_attitude_of_odometry(bags: dict[str, Path], flown: Piece) -> None:
    assert attitudes_agree(opened(bags["mcap"]).telemetry().samples, flown, 0.02)


def test_satellite_fixes(tmp_path: Path, flown: Piece) -> None:
    write_bag(tmp_path / "fixes", "mcap", flown, origin=HOME)
    flight = opened(tmp_path / "fixes")
    log = flight.telemetry()
    assert "heights of NavSatFix are above the ellipsoid" in whats(flight.warnings)
    fixes = [s for s in log.samples if isinstance(s, PositionSample)]
    assert {s.source for s in fixes} == {PositionSource.GPS}
    assert fixes[0].sigma_horizontal_m == pytest.approx(2.5**0.5)
    assert fixes[0].sigma_vertical_m == 3.0
    true = local_positions(flown)
    way = true[fixes[-1].t_ns].position_ned_m - true[fixes[0].t_ns].position_ned_m
    np.testing.assert_allclose(fixes[-1].position_ned_m - fixes[0].position_ned_m, way, atol=1e-3)
    assert attitudes_agree(log.samples, flown, 1e-6)
    assert log.origin is not None
    assert log.origin.latitude_deg == pytest.approx(HOME.latitude_deg, abs=0.01)


def test_compressed_pictures(tmp_path: Path, flown: Piece) -> None:
    write_bag(tmp_path / "flight.bag", "ros1", flown, compressed=True)
    flight = opened(tmp_path / "flight.bag")
    first = next(f for f in flight.frames() if isinstance(f, Frame))
    assert (first.rgb == flown.frames[0].rgb).all()
    assert flight.camera.fx == flown.camera.fx  # camera_info lies one name higher


@pytest.mark.parametrize("kind", KINDS)
def test_packed_bags(tmp_path: Path, flown: Piece, kind: str) -> None:
    write_bag(tmp_path / name_of(kind), kind, flown, packed=True)
    flight = opened(tmp_path / name_of(kind))
    first = next(f for f in flight.frames() if isinstance(f, Frame))
    assert (first.rgb == flown.frames[0].rgb).all()
    assert flight.telemetry().rates_hz["imu"] > 1


def test_topic_by_name(bags: dict[str, Path]) -> None:
    assert opened(bags["mcap"], topic=CAMERA).n_frames == 4
    with pytest.raises(FlightError, match=f"/rear.*{CAMERA}"):
        opened(bags["mcap"], topic="/rear")


def test_calibration_beside_wins(bags: dict[str, Path], flown: Piece, tmp_path: Path) -> None:
    shutil.copy(bags["ros1"], tmp_path / "flight.bag")
    write_flight_folder(tmp_path / "other", flown.without_lens().part(1))
    shutil.copy(tmp_path / "other" / "camera.json", tmp_path / "flight.json")
    assert opened(tmp_path / "flight.bag").camera.coefficients == ()


@pytest.mark.parametrize("kind", KINDS)
def test_cut_bag(bags: dict[str, Path], tmp_path: Path, kind: str) -> None:
    """What there is, or a line that says why not."""
    copy = tmp_path / bags[kind].name
    if kind == "ros1":
        copy.write_bytes(bags[kind].read_bytes()[:-1000])
    else:
        shutil.copytree(bags[kind], copy)
        (inside,) = (p for p in copy.iterdir() if p.suffix in (".db3", ".mcap"))
        inside.write_bytes(inside.read_bytes()[: inside.stat().st_size // 2])
    try:
        flight = opened(copy)
    except FlightError as error:
        assert str(copy) in str(error)
    else:
        assert len(list(flight.frames())) == flight.n_frames


@pytest.mark.parametrize(
    ("encoding", "pixel", "rgb"),
    [
        ("mono8", [77], [77, 77, 77]),
        ("mono16", [9, 77], [77, 77, 77]),
        ("rgb8", [10, 20, 30], [10, 20, 30]),
        ("bgr8", [10, 20, 30], [30, 20, 10]),
        ("rgba8", [10, 20, 30, 9], [10, 20, 30]),
        ("bgra8", [10, 20, 30, 9], [30, 20, 10]),
    ],
)
def test_encodings(encoding: str, pixel: list[int], rgb: list[int]) -> None:
    data = np.tile(np.array(pixel, np.uint8), (4, 6, 1))
    message = SimpleNamespace(
        height=4, width=6, encoding=encoding, is_bigendian=0, step=6 * len(pixel),
        data=data.ravel(),
    )  # fmt: skip
    found = rgb_of(message)
    assert found is not None
    assert found.shape == (4, 6, 3)
    assert (found == rgb).all()


@pytest.mark.parametrize(
    ("name", "first"), [("bayer_rggb8", 0), ("bayer_bggr8", 2)]
)  # fmt: skip
def test_bayer(name: str, first: int) -> None:
    """A picture with much red, less green and no blue, through its mosaic and back."""
    colour = [200, 100, 0]
    mosaic = np.empty((16, 16), np.uint8)
    mosaic[::2, ::2], mosaic[1::2, 1::2] = colour[first], colour[2 - first]
    mosaic[::2, 1::2] = mosaic[1::2, ::2] = colour[1]
    message = SimpleNamespace(
        height=16, width=16, encoding=name, is_bigendian=0, step=16, data=mosaic.ravel()
    )
    found = rgb_of(message)
    assert found is not None
    assert found[8, 8].tolist() == colour


def test_yuv() -> None:
    rgb = np.full((2, 4, 3), [200, 60, 30], np.uint8)
    yuv = cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV).astype(float)
    data = np.empty((2, 4, 2), np.uint8)
    data[..., 1] = np.rint(16 + yuv[..., 0] * 219 / 255)
    luma, red = float(yuv[0, 0, 0]), rgb[0, 0].astype(float)
    data[:, ::2, 0] = round(128 + (red[2] - luma) / 1.772 * 224 / 255)
    data[:, 1::2, 0] = round(128 + (red[0] - luma) / 1.402 * 224 / 255)
    message = SimpleNamespace(
        height=2, width=4, encoding="yuv422", is_bigendian=0, step=8, data=data.ravel()
    )
    found = rgb_of(message)
    assert found is not None
    np.testing.assert_allclose(found, rgb, atol=4)


def test_pictures_that_are_none() -> None:
    whole = {"height": 4, "width": 6, "encoding": "mono8", "is_bigendian": 0, "step": 6}
    for change in ({"height": 5}, {"step": 5}, {"width": 0}, {"height": 2**31, "step": 2**31}):
        message = SimpleNamespace(**{**whole, **change}, data=np.zeros(24, np.uint8))
        assert rgb_of(message) is None
    assert rgb_of(SimpleNamespace(format="jpeg", data=np.arange(50, dtype=np.uint8))) is None
    with pytest.raises(FlightError, match="32FC1"):
        rgb_of(SimpleNamespace(**{**whole, "encoding": "32FC1"}, data=np.zeros(96, np.uint8)))
