from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.camera import Distortion
from companion.errors import FlightError
from drivers.calibration import assumed_camera, read_calibration

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


def test_assumed_camera_sees_as_wide_as_said() -> None:
    camera = assumed_camera(640, 480, 90.0)
    assert camera.assumed
    left = camera.normalise(np.array([[-0.5, 239.5]]))[0]
    np.testing.assert_allclose(left, [-1, 0], atol=1e-12)
