"""Geotagged stills as a flight."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.config import CameraConfig
from companion.errors import FlightError
from companion.geometry.transforms import rotation_from_quaternion
from companion.messages import Frame, Warned
from companion.telemetry import AttitudeSample, PositionSample
from drivers.flight import Flight
from drivers.images.exif import read_photo
from drivers.open_flight import format_of, open_flight
from tests.support.cameras.photos import Base, write_photo

HOME = (-35.36, -70.25)
T0_NS = 1_762_000_000_000_000_000
DJI = (
    '<x:xmpmeta><rdf:Description drone-dji:AbsoluteAltitude="+610.20" '
    'drone-dji:RelativeAltitude="+{height:.2f}" drone-dji:GimbalRollDegree="+0.00" '
    'drone-dji:GimbalYawDegree="-90.00" drone-dji:GimbalPitchDegree="-60.00"/></x:xmpmeta>'
)


def write(folder: Path, n: int = 12, climb_m: float = 0.0, **options: Any) -> None:
    """Photos two seconds apart, each 5 m further north, in a zone five hours behind UTC."""
    for k in range(n):
        second = 40 + 2 * k
        clock = f"2025:11:01 {{:02d}}:{26 + second // 60:02d}:{second % 60:02d}"
        time = (12.0, 26.0 + second // 60, float(second % 60))
        write_photo(
            folder / f"IMG_{k:04d}.jpg", k,
            local=clock.format(7), utc=("2025:11:01", time),
            place=(HOME[0] + k * 5 / 110_940, HOME[1], 500.0 + climb_m * k), **options,
        )  # fmt: skip


def opened(folder: Path) -> Flight:
    return open_flight(folder, CameraConfig(assumed_hfov_deg=60))


def whats(warnings: Sequence[Warned]) -> list[str]:
    return [warned.what for warned in warnings]


def positions(flight: Flight) -> list[PositionSample]:
    return [s for s in flight.telemetry().samples if isinstance(s, PositionSample)]


def test_flight(tmp_path: Path) -> None:
    """Times in UTC although the camera's zone is not told; south and west are negative."""
    write(tmp_path)
    assert format_of(tmp_path).name == "geotagged photographs"
    flight = opened(tmp_path)
    assert flight.times_ns == tuple(T0_NS + k * 2_000_000_000 for k in range(12))
    frames = [f for f in flight.frames() if isinstance(f, Frame)]
    found = [round((float(f.grey[40, 40]) - 20) / 12) for f in frames]
    assert found == list(range(12))
    log = flight.telemetry()
    assert log.origin is not None
    assert log.origin.latitude_deg == pytest.approx(HOME[0], abs=1e-7)
    assert log.origin.longitude_deg == pytest.approx(HOME[1], abs=1e-7)
    assert log.origin.altitude_m == pytest.approx(500)
    np.testing.assert_allclose(positions(flight)[7].position_ned_m, [35, 0, 0], atol=0.02)


def test_focal_length_of_a_smaller_copy(tmp_path: Path) -> None:
    """By the sensor's width, which the original's pixels tell, not by the copy's."""
    shot = {
        Base.FocalLength: 4.5, Base.FocalPlaneXResolution: 16393.44,
        Base.FocalPlaneResolutionUnit: 2, Base.ExifImageWidth: 4000,
    }  # fmt: skip
    write(tmp_path, 3, shot=shot)
    flight = opened(tmp_path)
    assert flight.camera.fx == pytest.approx(4.5 / (4000 / 16393.44 * 25.4) * 64, rel=1e-4)
    assert flight.camera.assumed
    told = {warned.what: warned.detail for warned in flight.warnings}
    assert "by Maker Model," in told["no camera.json: the focal length is that of EXIF"]


def test_maker_is_said_once(tmp_path: Path) -> None:
    write_photo(tmp_path / "a.jpg", 0, model="Maker A1")
    photo = read_photo(tmp_path / "a.jpg")
    assert photo is not None and photo.camera == "Maker A1"


def test_focal_length_for_film(tmp_path: Path) -> None:
    write(tmp_path, 3, shot={Base.FocalLengthIn35mmFilm: 24})
    assert opened(tmp_path).camera.fx == pytest.approx(24 / 43.2666 * math.hypot(64, 48))


def test_no_focal_length(tmp_path: Path) -> None:
    write(tmp_path, 3)
    assert whats(opened(tmp_path).warnings) == ["no camera.json: the camera is assumed"]


def test_heights_that_drift_are_not_believed(tmp_path: Path) -> None:
    write(tmp_path, climb_m=8.0)
    flight = opened(tmp_path)
    what = "heights in EXIF are suspect: the flight is taken to be level"
    assert what in whats(flight.warnings)
    assert np.ptp([p.position_ned_m[2] for p in positions(flight)]) < 0.01


def test_heights_that_are_missing(tmp_path: Path) -> None:
    write(tmp_path)
    write_photo(tmp_path / "IMG_0003.jpg", 3, local="2025:11:01 07:26:46", place=(*HOME, None))
    flight = opened(tmp_path)
    assert "heights are missing in EXIF: the flight is taken to be level" in whats(flight.warnings)


def test_gimbal_and_barometer(tmp_path: Path) -> None:
    """DJI's own: heights above the start, and where the camera looked: west, 60 degrees down."""
    for k in range(10):
        write_photo(
            tmp_path / f"DJI_{k:04d}.jpg", k, local=f"2025:11:01 07:26:{40 + k}",
            place=(HOME[0] + k * 1e-5, HOME[1], 600.0 + 3 * k), xmp=DJI.format(height=20.5 + k),
        )  # fmt: skip
    flight = opened(tmp_path)
    heights = [-p.position_ned_m[2] for p in positions(flight)]
    np.testing.assert_allclose(np.diff(heights), 1.0, atol=1e-3)
    attitude = next(s for s in flight.telemetry().samples if isinstance(s, AttitudeSample))
    assert flight.camera.body_from_camera is not None
    ned_from_camera = (
        rotation_from_quaternion(attitude.ned_from_body) @ flight.camera.body_from_camera.rotation
    )
    np.testing.assert_allclose(ned_from_camera[:, 2], [0, -0.5, math.sqrt(0.75)], atol=1e-6)
    np.testing.assert_allclose(ned_from_camera[:, 0], [1, 0, 0], atol=1e-6)


def test_several_in_one_second(tmp_path: Path) -> None:
    for k in range(6):
        write_photo(
            tmp_path / f"a{k}.jpg", k, local=f"2025:11:01 12:26:{40 + k // 3}", place=(*HOME, 1.0)
        )
    steps = np.diff(opened(tmp_path).times_ns) * 1e-9
    np.testing.assert_allclose(steps, 1 / 3, atol=1e-6)


def test_parts_of_seconds(tmp_path: Path) -> None:
    for k in range(3):
        write_photo(
            tmp_path / f"a{k}.jpg", k, local="2025:11:01 12:26:40", subsecond=f"{25 * (k + 1)}",
            place=(*HOME, 1.0),
        )  # fmt: skip
    after = np.array(opened(tmp_path).times_ns) - T0_NS
    assert after.tolist() == [250_000_000, 500_000_000, 750_000_000]


def test_place_that_is_not_new(tmp_path: Path) -> None:
    write(tmp_path)
    write_photo(
        tmp_path / "IMG_0006.jpg", 6, local="2025:11:01 07:26:52",
        place=(HOME[0] + 5 * 5 / 110_940, HOME[1], 500.0),
    )  # fmt: skip
    flight = opened(tmp_path)
    flight.telemetry()
    assert len(positions(flight)) == 11
    assert "places that were not new left out" in whats(flight.warnings)


def test_photographs_without_times(tmp_path: Path) -> None:
    for k in range(3):
        write_photo(tmp_path / f"a{k}.jpg", k, place=(*HOME, 1.0))
    with pytest.raises(FlightError, match="0 have a time"):
        opened(tmp_path)


@pytest.mark.parametrize("seed", range(40))
def test_damaged_photograph(tmp_path: Path, seed: int) -> None:
    """None, or facts that are finite; never anything else."""
    rng = np.random.default_rng(seed)
    write_photo(tmp_path / "a.jpg", 1, local="2025:11:01 12:26:40", place=(*HOME, 1.0),
                xmp=DJI.format(height=3))  # fmt: skip
    data = bytearray((tmp_path / "a.jpg").read_bytes())
    for at in rng.integers(0, 700, 12):
        data[at] = rng.integers(256)
    (tmp_path / "a.jpg").write_bytes(data[: int(rng.integers(10, len(data)))])
    photo = read_photo(tmp_path / "a.jpg")
    if photo is not None and photo.latitude_deg is not None:
        assert abs(photo.latitude_deg) <= 90
