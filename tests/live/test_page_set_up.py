"""Mount and lens are found by the recording of the flight that goes on, and used."""

from __future__ import annotations

import itertools
import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from companion.config import CameraConfig, Config
from companion.config_file import load_config
from companion.geometry.camera import Camera
from companion.geometry.transforms import (
    Pose,
    angle_between,
    quaternion_from_euler,
    quaternion_from_rotation,
    rotation_from_quaternion,
)
from companion.messages import Bytes, Frame
from companion.telemetry import AttitudeSample
from drivers.camera.live_calibration import body_from_camera
from drivers.camera.pattern_camera import BODY_FROM_CAMERA, PatternScene, pattern_optics
from drivers.images.calibration_file import read_calibration
from drivers.recording.recorder import Recorder
from tests.support.cameras.board_pictures import CHARUCO, RADTAN, well_shown
from tests.support.served_page import ELSEWHERE, ServedPage

NAME = "00001-2026-11-19T10-00-00Z"
PATIENCE_S = 200.0
RATE_HZ = 12
Shown = Callable[[int], tuple[Bytes, Bytes]]


def in_hands(t_ns: int) -> Pose:
    """Leaned, lifted and turned, moved a little."""
    angles = np.radians([22.0, 20.0, 25.0]) * np.sin(
        2 * math.pi * t_ns * 1e-9 * np.array([0.1, 0.13, 0.08]) + np.array([0.0, 1.0, 2.0])
    )
    t_s = t_ns * 1e-9
    place = np.array([math.sin(0.7 * t_s), math.cos(0.5 * t_s), -6.0 + 0.5 * math.sin(0.4 * t_s)])
    return Pose(rotation_from_quaternion(quaternion_from_euler(*angles)), place)


@contextmanager
def recorded(served: ServedPage, camera: Camera, shown: Shown) -> Iterator[None]:
    """A flight that goes on and is recorded: what the camera is shown, attitudes as in hands."""
    folder = served.flights / NAME
    folder.mkdir(parents=True)
    served.status |= {"recording": str(folder), "size": [320, 240]}
    recorder, over = Recorder(folder, Config(), camera, {}), threading.Event()

    def film() -> None:
        for number in itertools.count():
            t_ns = time.monotonic_ns()
            grey, rgb = shown(t_ns)
            recorder.take(Frame(number, t_ns, grey, rgb))
            for k in range(3):
                at_ns = t_ns + k * 25_000_000
                attitude = quaternion_from_rotation(in_hands(at_ns).rotation)
                recorder.take(AttitudeSample(at_ns, attitude))
            if over.wait(1.0 / RATE_HZ):
                return

    filming = threading.Thread(target=film)
    filming.start()
    try:
        yield
    finally:
        over.set()
        filming.join()
        recorder.close()


def done(served: ServedPage, name: str, words: str) -> None:
    """Begin a step of setting up, and wait until it says something."""
    headers, token = served.changer()
    form = {"token": token}
    path = f"/setup/{name}"
    assert (
        served.ask("POST", path + "/begin", headers=headers, peer=ELSEWHERE, form=form).status
        == 303
    )
    until_s = time.monotonic() + PATIENCE_S
    while words not in (
        text := served.ask("GET", path + "/panel", headers={"host": "localhost"}).text
    ):
        assert time.monotonic() < until_s and "note bad" not in text, text
        served.now_s += 1.0  # the page allows a peer some questions a second
        time.sleep(0.1)
    answer = served.ask("POST", path + "/use", headers=headers, peer=ELSEWHERE, form=form)
    assert answer.status == 303, answer.text


@pytest.fixture
def served(tmp_path: Path) -> Iterator[ServedPage]:
    with ServedPage(tmp_path) as served:
        yield served


def test_the_mount_is_found_by_hand(served: ServedPage) -> None:
    optics, scene = pattern_optics(CameraConfig(width=320, height=240)), PatternScene()
    with recorded(
        served, replace(optics, body_from_camera=None),
        lambda t_ns: scene.picture(optics, in_hands(t_ns) @ BODY_FROM_CAMERA),
    ):  # fmt: skip
        done(served, "mount", "Found: roll")
    mount = load_config(served.config).mount
    assert mount.known
    off = angle_between(body_from_camera(mount).rotation, BODY_FROM_CAMERA.rotation)
    assert math.degrees(off) < 1.0


def test_the_lens_is_calibrated_by_a_board(served: ServedPage) -> None:
    boards = [np.asarray(each, np.uint8) for each in well_shown(RADTAN, CHARUCO, 0.0)]

    def shown(t_ns: int) -> tuple[Bytes, Bytes]:
        grey = boards[t_ns // 1_000_000_000 % len(boards)]
        return grey, np.repeat(grey[..., None], 3, axis=2)

    with recorded(served, RADTAN, shown):
        done(served, "lens", "Calibrated, and written to")
    path = Path(load_config(served.config).camera.calibration)
    assert path.parent == served.config.parent / "calibrations"
    lens = read_calibration(path, RADTAN.width, RADTAN.height)
    assert lens.fx == pytest.approx(RADTAN.fx, rel=0.01)
    assert lens.cx == pytest.approx(RADTAN.cx, abs=3.0)
