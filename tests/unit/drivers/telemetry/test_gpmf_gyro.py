"""GoPro gyroscope, and time alignment of a log by it, without any texture in the images."""

from __future__ import annotations

import json
import shutil
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from companion.config import CameraConfig, TelemetryConfig
from companion.errors import FlightError
from companion.geometry.transforms import Array, rotation_from_quaternion, vector_from_rotation
from drivers.open_flight import open_flight
from drivers.telemetry.gpmf_gyro import gyro_rotation
from tests.support.cameras.gopro import gyro_block, write_gopro

SAMPLE = Path(__file__).parents[4] / "sample" / "survey"
SECOND = 1_000_000_000
HERO5 = "Gyroscope (z,x,y)"
RATE_HZ = 200


def hero5_from_camera(rates: Array) -> Array:
    """Up, left, back from right, down, forward."""
    return -rates[:, [1, 0, 2]]


def test_turns_about_the_axes_of_the_camera() -> None:
    """A turn to the right, then a roll, at half a radian a second; a block between is damaged."""
    right, roll = (np.tile(axis, (RATE_HZ, 1)) for axis in ([0, 0.5, 0], [0, 0, 0.5]))
    good = [gyro_block(hero5_from_camera(turn), HERO5) for turn in (right, right, roll)]
    contents = [good[0], b"DEVC\0\1\xff\xff", good[1], good[2]]
    blocks = [(k * SECOND, (k + 1) * SECOND, block) for k, block in enumerate(contents)]
    turns = gyro_rotation(blocks)
    assert turns is not None and turns.axes_known
    assert turns.t_ns[0] == 0.5 / RATE_HZ * SECOND
    at = np.searchsorted(turns.t_ns, 3 * SECOND)
    np.testing.assert_allclose(turns.angle_rad[at], [0, 1, 0], atol=0.02)
    np.testing.assert_allclose(turns.angle_rad[-1], [0, 1, 0.5], atol=0.02)


@pytest.mark.parametrize(
    ("name", "orientation", "known"),
    [("Gyroscope", "ZXY", True), (HERO5, "zxY", True), ("Gyroscope", "", False),
     ("Gyroscope", "ZXX", False), ("Gyroscope", "zXY", False)],
)  # fmt: skip
def test_axes_known_or_unknown(name: str, orientation: str, known: bool) -> None:
    """The last one would be left-handed."""
    rates = np.tile([0.1, 0.2, 0.3], (RATE_HZ, 1))
    turns = gyro_rotation([(0, SECOND, gyro_block(rates, name, orientation))])
    assert turns is not None and turns.axes_known == known
    told = {"ZXY": [-0.2, -0.1, -0.3], "zxY": [0.2, 0.1, -0.3]}
    expected = told.get(orientation, [0.1, 0.2, 0.3])
    found = turns.angle_rad[-1] / ((turns.t_ns[-1] - turns.t_ns[0]) / SECOND)
    np.testing.assert_allclose(found, expected, atol=0.001)


def test_a_video_without_is_known_as_such() -> None:
    assert gyro_rotation([]) is None
    assert gyro_rotation([(0, SECOND, gyro_block(np.zeros((3, 3)), HERO5))]) is None


def felt(first_ns: int) -> list[Array]:
    """Rates of each second, as a gyro would have felt them in the sample, by its true poses."""
    rows = np.loadtxt(SAMPLE / "truth" / "world_from_camera.tum")
    turned = [rotation_from_quaternion(q) for q in rows[:, [7, 4, 5, 6]]]
    rates = np.array([
        vector_from_rotation(a.T @ b) for a, b in pairwise(turned)
    ]) / np.diff(rows[:, 0])[:, None]  # fmt: skip
    middle_s = 0.5 * (rows[1:, 0] + rows[:-1, 0]) - first_ns * 1e-9
    t_s = (np.arange(int(middle_s[-1]) * RATE_HZ) + 0.5) / RATE_HZ
    even = np.stack([np.interp(t_s, middle_s, axis) for axis in rates.T], 1)
    return np.split(even, len(t_s) // RATE_HZ)


@pytest.mark.parametrize("name", [HERO5, "Gyroscope"])
def test_a_log_is_put_on_the_time_of_the_camera(tmp_path: Path, name: str) -> None:
    first_ns = int((SAMPLE / "frames.csv").read_text().splitlines()[1].split(",")[1])
    blocks = [gyro_block(hero5_from_camera(rates), name) for rates in felt(first_ns)]
    video = tmp_path / "flown.mp4"
    write_gopro(video, 10 * len(blocks), 10, blocks)
    shutil.copy(SAMPLE / "telemetry.tlog", tmp_path / "flown.tlog")
    camera = json.loads((SAMPLE / "camera.json").read_text())
    small = {key: camera[key] / 10 for key in ("fx", "fy", "cx", "cy")}
    camera = {**camera, **small, "width": 64, "height": 48}
    (tmp_path / "flown.json").write_text(json.dumps(camera))
    log = open_flight(video, CameraConfig(), TelemetryConfig()).telemetry()
    assert log.clock is not None and log.clock.method == "rotation of the camera's gyro"
    assert log.clock.offset_s == pytest.approx(-first_ns * 1e-9, abs=0.03)
    assert "flown.mp4 by rotation of the camera's gyro: -1795" in log.remarks[0]


def test_a_log_of_another_flight_is_refused(tmp_path: Path) -> None:
    """What neither gyro nor pictures agree with."""
    still = gyro_block(np.zeros((RATE_HZ, 3)), HERO5)
    write_gopro(tmp_path / "flown.mp4", 200, 10, [still] * 20)
    shutil.copy(SAMPLE / "telemetry.tlog", tmp_path / "flown.tlog")
    with pytest.raises(FlightError, match="hardly turns"):
        open_flight(tmp_path / "flown.mp4", CameraConfig(), TelemetryConfig()).telemetry()
