from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.config import CameraConfig, MountConfig
from companion.errors import ConfigError, FlightError
from companion.geometry.camera import Distortion
from companion.geometry.gimbal import Gimbal
from drivers.camera.live_calibration import body_from_camera, is_on_gimbal, live_camera
from drivers.images.calibration_file import (
    FORWARD_UPRIGHT,
    assumed_camera,
    read_calibration,
    with_readout,
)
from drivers.images.camera_document import camera_document, camera_of

GOOD: dict[str, Any] = {
    "width": 64, "height": 48, "fx": 50.0, "fy": 51.0, "cx": 31.0, "cy": 24.0,
    "distortion_model": "radtan", "k1": -0.1, "k2": 0.02, "p1": 0.001, "p2": -0.002, "k3": 0.0,
}  # fmt: skip
TURNED: list[list[float]] = [
    [0, -0.8, 0.6, 0.12],
    [1, 0, 0, 0],
    [0, 0.6, 0.8, 0.05],
    [0, 0, 0, 1.0],
]


def write(folder: Path, **changes: Any) -> Path:
    content = {key: value for key, value in {**GOOD, **changes}.items() if value is not None}
    path = folder / "camera.json"
    path.write_text(json.dumps(content))
    return path


def test_all_that_it_says(tmp_path: Path) -> None:
    camera = read_calibration(write(tmp_path, body_from_camera=TURNED), 64, 48)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (50, 51, 31, 24)
    assert camera.distortion is Distortion.RADTAN
    assert camera.coefficients == (-0.1, 0.02, 0.001, -0.002, 0.0)
    assert camera.body_from_camera is not None
    np.testing.assert_allclose(camera.body_from_camera.matrix(), np.array(TURNED), atol=1e-12)
    assert not camera.assumed


@pytest.mark.parametrize(
    ("model", "given", "distortion", "wanted"),
    [
        ("radtan", [0.1, 0.2, 0.3, 0.4], Distortion.RADTAN, (0.1, 0.2, 0.3, 0.4, 0.0)),
        ("plumb_bob", [0.1, 0.2, 0.3, 0.4, 0.5], Distortion.RADTAN, (0.1, 0.2, 0.3, 0.4, 0.5)),
        ("fisheye", [0.1, 0.2, 0.3, 0.4], Distortion.EQUIDISTANT, (0.1, 0.2, 0.3, 0.4)),
        ("equidistant", [1, 2, 3, 4], Distortion.EQUIDISTANT, (1, 2, 3, 4)),
        ("none", [], Distortion.NONE, ()),
        ("pinhole", [0, 0, 0, 0, 0], Distortion.NONE, ()),
    ],
)
def test_coefficients_as_a_list(
    tmp_path: Path,
    model: str,
    given: list[float],
    distortion: Distortion,
    wanted: tuple[float, ...],
) -> None:
    camera = read_calibration(write(tmp_path, distortion_model=model, D=given), 64, 48)
    assert camera.distortion is distortion
    assert camera.coefficients == wanted


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fx": None}, ["fx", "missing"]),
        ({"fx": "wide"}, ["fx", "wide"]),
        ({"fx": -3}, ["fx", "positive"]),
        ({"fy": True}, ["fy", "True"]),
        ({"cx": 100}, ["outside"]),
        ({"width": 128}, ["128 x 48", "64 x 48"]),
        ({"k2": None}, ["k2"]),
        ({"k1": float("nan")}, ["k1", "nan"]),
        ({"distortion_model": None}, ["distortion_model"]),
        ({"distortion_model": "thin_prism"}, ["thin_prism", "radtan"]),
        ({"distortion_model": "fisheye", "D": [1, 2]}, ["2", "4"]),
        ({"D": "none"}, ["list"]),
        ({"body_from_camera": [[1, 0], [0, 1]]}, ["body_from_camera", "4 x 4"]),
        ({"body_from_camera": [["a"] * 4] * 4}, ["body_from_camera"]),
        ({"body_from_camera": np.diag([1, 1, -1, 1]).tolist()}, ["rotation"]),
        ({"body_from_camera": (2 * np.eye(4)).tolist()}, ["rotation"]),
    ],
)
def test_what_is_wrong_is_one_line(
    tmp_path: Path, changes: dict[str, Any], words: list[str]
) -> None:
    with pytest.raises(FlightError) as raised:
        read_calibration(write(tmp_path, **changes), 64, 48)
    line = str(raised.value)
    assert "\n" not in line
    assert all(word in line for word in ["camera.json", *words])


@pytest.mark.parametrize("content", [b"{", b"", b"[1, 2]", b"\xff\xfe\x00"])
def test_no_json(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "camera.json").write_bytes(content)
    with pytest.raises(FlightError, match=r"camera\.json"):
        read_calibration(tmp_path / "camera.json", 64, 48)


def test_readout_is_read_and_what_is_configured_goes_before(tmp_path: Path) -> None:
    assert read_calibration(write(tmp_path), 64, 48).readout_ms is None
    stated = read_calibration(write(tmp_path, readout_ms=18.5), 64, 48)
    assert stated.readout_ms == 18.5
    assert with_readout(stated, -1.0) is stated
    assert with_readout(stated, 0.0).readout_ms == 0.0
    config = CameraConfig(calibration=str(write(tmp_path, readout_ms=18.5)), readout_ms=25.0)
    assert live_camera(config, MountConfig(), 64, 48)[0].readout_ms == 25.0
    assert camera_of(camera_document(stated)).readout_ms == 18.5


@pytest.mark.parametrize("wrong", [-1, 201, "25", True, float("inf")])
def test_a_readout_that_cannot_be_is_refused(tmp_path: Path, wrong: object) -> None:
    with pytest.raises(FlightError, match="readout_ms"):
        read_calibration(write(tmp_path, readout_ms=wrong), 64, 48)


def test_a_configured_readout_that_cannot_be_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"camera\.readout_ms = -0\.5"):
        with_readout(assumed_camera(64, 48, 70.0), -0.5)


def test_assumed_camera_sees_as_wide_as_said() -> None:
    camera = assumed_camera(640, 480, 90.0)
    assert camera.assumed
    left = camera.normalise(np.array([[-0.5, 239.5]]))[0]
    np.testing.assert_allclose(left, [-1, 0], atol=1e-12)


TOML = """
width = 64
height = 48
fx = 50.0
fy = 51
cx = 31.0
cy = 24.0
distortion_model = "radtan"
k1 = -0.1
k2 = 0.02
p1 = 0.001
p2 = -0.002
rms_px = 0.21
"""
IN_TOML = f"body_from_camera = {TURNED}"
MOUNT = MountConfig(known=True, roll_deg=10, pitch_deg=-35, yaw_deg=70, x_m=0.1, y_m=-0.2, z_m=0.3)


def toml(folder: Path, content: str) -> CameraConfig:
    path = folder / "front.toml"
    path.write_text(content)
    return CameraConfig(calibration=str(path))


def test_toml_says_the_same_as_json(tmp_path: Path) -> None:
    camera, warnings = live_camera(toml(tmp_path, TOML + IN_TOML), MountConfig(), 64, 48)
    assert (camera.fx, camera.fy, camera.coefficients) == (50, 51, (-0.1, 0.02, 0.001, -0.002, 0.0))
    assert camera.body_from_camera is not None
    np.testing.assert_allclose(camera.body_from_camera.matrix(), np.array(TURNED), atol=1e-12)
    assert not camera.assumed
    assert warnings == []


def test_damaged_toml_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(FlightError, match=r"front\.toml: cannot be read as TOML"):
        live_camera(toml(tmp_path, "width = = 3"), MountConfig(), 64, 48)
    with pytest.raises(FlightError, match=r"none\.toml: cannot be read"):
        live_camera(CameraConfig(calibration="none.toml"), MountConfig(), 64, 48)


def test_mount_turns_by_yaw_then_pitch_then_roll() -> None:
    camera, _ = live_camera(CameraConfig(), MOUNT, 640, 480)
    assert camera.body_from_camera is not None
    rotation = camera.body_from_camera.rotation
    pitch, yaw = np.radians([-35, 70])
    forward = [np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), -np.sin(pitch)]
    np.testing.assert_allclose(rotation @ [0, 0, 1], forward, atol=1e-12)
    # before the roll the picture's right is level; clockwise by 10 degrees it points down
    assert (rotation @ [1, 0, 0])[2] == pytest.approx(np.sin(np.radians(10)) * np.cos(pitch))
    assert np.linalg.det(rotation) == pytest.approx(1)
    np.testing.assert_allclose(camera.body_from_camera.translation, [0.1, -0.2, 0.3])


@pytest.mark.parametrize(
    ("mount", "forward", "right"),
    [
        (MountConfig(known=True), [1, 0, 0], [0, 1, 0]),
        (MountConfig(known=True, pitch_deg=-90), [0, 0, 1], [0, 1, 0]),
        (MountConfig(known=True, yaw_deg=90), [0, 1, 0], [-1, 0, 0]),
        (MountConfig(known=True, roll_deg=90), [1, 0, 0], [0, 0, 1]),
    ],
)
def test_simple_mounts(mount: MountConfig, forward: list[int], right: list[int]) -> None:
    pose = body_from_camera(mount)
    np.testing.assert_allclose(pose.rotation @ [0, 0, 1], forward, atol=1e-12)
    np.testing.assert_allclose(pose.rotation @ [1, 0, 0], right, atol=1e-12)


def test_two_places_on_the_body_are_one_too_many(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"front\.toml.*\[mount\]"):
        live_camera(toml(tmp_path, TOML + IN_TOML), MOUNT, 64, 48)
    camera, _ = live_camera(toml(tmp_path, TOML), MOUNT, 64, 48)
    assert camera.body_from_camera is not None


def test_what_is_assumed_is_said() -> None:
    camera, warnings = live_camera(CameraConfig(assumed_hfov_deg=90), MountConfig(), 640, 480)
    assert camera.assumed
    assert camera.fx == pytest.approx(320)
    assert ["90 degrees" in warnings[0], "[mount]" in warnings[1]] == [True, True]
    with pytest.raises(ConfigError, match="assumed_hfov_deg"):
        live_camera(CameraConfig(assumed_hfov_deg=0), MountConfig(), 640, 480)


def test_a_flight_played_as_camera_has_its_own_calibration(tmp_path: Path) -> None:
    write(tmp_path, body_from_camera=TURNED)
    config = CameraConfig(source="file", path=str(tmp_path))
    camera, warnings = live_camera(config, MountConfig(), 64, 48)
    assert (camera.fx, warnings) == (50, [])


def test_a_gimbal_is_read_and_recorded(tmp_path: Path) -> None:
    assert read_calibration(write(tmp_path), 64, 48).gimbal is None
    said = {"place_body_m": [0.1, 0, 0.2], "delay_ms": 30}
    stated = read_calibration(write(tmp_path, body_from_camera=TURNED, gimbal=said), 64, 48)
    assert stated.gimbal == Gimbal((0.1, 0.0, 0.2), 30.0, 1.0)
    assert camera_of(camera_document(stated)).gimbal == stated.gimbal
    config = CameraConfig(calibration=str(tmp_path / "camera.json"))
    assert live_camera(config, MountConfig(), 64, 48)[0].gimbal == stated.gimbal


def test_a_gimbal_is_known_before_the_first_frame(tmp_path: Path) -> None:
    config, mount = CameraConfig(calibration=str(tmp_path / "camera.json")), MountConfig()
    assert not is_on_gimbal(config, mount)  # there is no file: the first frame says so
    assert is_on_gimbal(config, MountConfig(type="gimbal"))
    write(tmp_path, body_from_camera=TURNED)
    assert not is_on_gimbal(config, mount)
    write(tmp_path, body_from_camera=TURNED, gimbal={})
    assert is_on_gimbal(config, mount)


@pytest.mark.parametrize(
    "wrong",
    [
        3, {"place": [0, 0, 0]}, {"place_body_m": [0, 0]}, {"place_body_m": [0, 0, 200]},
        {"delay_ms": float("nan")}, {"sigma_deg": 0}, {"sigma_deg": "1"}, {"delay_ms": True},
    ],
)  # fmt: skip
def test_a_gimbal_that_cannot_be_is_refused(tmp_path: Path, wrong: object) -> None:
    with pytest.raises(FlightError, match=r"camera\.json: gimbal"):
        read_calibration(write(tmp_path, gimbal=wrong), 64, 48)


def test_a_configured_gimbal_carries_a_camera_that_looks_forward(tmp_path: Path) -> None:
    mount = MountConfig(type="gimbal", x_m=0.1, z_m=0.2, gimbal_sigma_deg=2.0)
    config = CameraConfig(calibration=str(write(tmp_path)))
    camera, warnings = live_camera(config, mount, 64, 48)
    assert camera.gimbal == Gimbal((0.1, 0.0, 0.2), 0.0, 2.0) and not warnings
    assert camera.body_from_camera is not None
    np.testing.assert_allclose(camera.body_from_camera.rotation, FORWARD_UPRIGHT, atol=1e-12)
    assert not camera.body_from_camera.translation.any()
    inside = live_camera(
        CameraConfig(calibration=str(write(tmp_path, body_from_camera=TURNED))), mount, 64, 48
    )[0].body_from_camera
    assert inside is not None
    np.testing.assert_allclose(inside.matrix(), np.array(TURNED), atol=1e-12)
