"""The readout of a rolling shutter by points with exact row times, and what is said of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from companion.estimation.attitude.camera_attitude import CameraAttitude
from companion.estimation.camera_motion import CameraMotion
from companion.estimation.shutter.shutter_of_frames import (
    OTHER_READOUT,
    ROLLING,
    ShutterOfFrames,
)
from companion.geometry.camera import Camera
from companion.geometry.transforms import (
    Array,
    Pose,
    quaternion_from_rotation,
    rotation_from_vector,
    yaw_rotation,
)
from companion.messages import Frame, Warned
from companion.slam.features.orb_features import Ints, features_of
from companion.slam.features.view import View
from companion.slam.map.sparse_map import SlamMap
from companion.telemetry import AttitudeSample
from tests.support.flights.scene import DOWN_LOOKING

MOUNT = Pose(DOWN_LOOKING, np.zeros(3))
CAMERA = Camera(640, 480, 480.0, 480.0, 320.0, 240.0, body_from_camera=MOUNT)
NOISE_PX = 0.35
GREY = np.zeros((480, 640), np.uint8)
FRAME = Frame(0, 0, GREY, np.zeros((0, 0, 3), np.uint8))


def body(t_s: float) -> Pose:
    """Turns to 120 degrees/s, in the wind, above the middle of the points."""
    yaw = 1.6 * np.sin(1.3 * t_s)
    tilt = np.array([0.12 * np.sin(2.9 * t_s), 0.1 * np.sin(2.3 * t_s + 1), 0.0])
    place = np.array([4 * np.sin(0.5 * t_s), 3 * np.cos(0.4 * t_s), -12.0])
    return Pose(yaw_rotation(yaw) @ rotation_from_vector(tilt), place)


def seen(points: Array, t_s: float, readout_s: float) -> Array:
    """Pixels (N, 2) of points, each at the time at which its own row is exposed."""
    times = np.linspace(-0.7, 0.7, 15) * readout_s
    pixels = np.stack(
        [CAMERA.project((body(t_s + t) @ MOUNT).inverse().apply(points)) for t in times.tolist()]
    )
    place = pixels[..., 1] / (CAMERA.height - 1) - 0.5
    late = np.linspace(-0.7, 0.7, 15)[:, None] - place  # rises
    after = np.clip((late < 0).sum(0), 1, len(times) - 1)
    n = np.arange(len(points))
    a, b = late[after - 1, n], late[after, n]
    share = (-a / (b - a))[:, None]
    out: Array = (1 - share) * pixels[after - 1, n] + share * pixels[after, n]
    return out


def flown(readout_s: float, stated_ms: float | None = None) -> list[Warned]:
    """What is said of a flight of 12 s with tracked points, over a map that is right.

    `readout_s` is what a stated readout has left over.
    """
    rng = np.random.default_rng(5)
    slam_map = SlamMap(1.2, 8)
    slam_map.positions = np.c_[rng.uniform(-14, 14, (400, 2)), rng.uniform(-2, 0, 400)]
    shutter = ShutterOfFrames(replace(CAMERA, readout_ms=stated_ms))
    attitude, motion = CameraAttitude(MOUNT), CameraMotion()
    said = []
    for t_s in np.arange(5.0, 17.0, 0.1).tolist():
        for t in np.arange(t_s, t_s + 0.1, 0.02).tolist():
            attitude.add(AttitudeSample(round(t * 1e9), quaternion_from_rotation(body(t).rotation)))
        pixels = seen(slam_map.positions, t_s, readout_s)
        pixels += rng.normal(scale=NOISE_PX, size=pixels.shape)
        ids = np.flatnonzero(((pixels > 10) & (pixels < [630, 470])).all(1))
        view = view_of(pixels[ids], ids, t_s)
        shutter.begin(replace(FRAME, t_ns=view.t_ns), attitude, motion)
        said += shutter.end(view, slam_map)
    return said


def view_of(pixels: Array, ids: Ints, t_s: float) -> View:
    n = len(ids)
    features = features_of(
        CAMERA, 1.2, pixels.astype(np.float32), CAMERA.normalise(pixels), np.zeros(n, np.int64),
        np.zeros(n, np.float32), np.zeros((n, 32), np.uint8),
    )  # fmt: skip
    pose = (body(t_s) @ MOUNT).inverse()
    return View(0, round(t_s * 1e9), features, None, GREY, pose, ids)


def readout_ms(warned: Warned) -> float:
    return float(warned.detail.split("over ")[1].split(" ")[0])


def test_a_rolling_shutter_is_noticed_once_with_its_readout() -> None:
    (warned,) = flown(0.024)
    assert warned.what == ROLLING
    assert readout_ms(warned) == pytest.approx(24.0, abs=2.0)


def test_a_wrong_readout_is_noticed() -> None:
    (warned,) = flown(0.014, stated_ms=10.0)
    assert warned.what == OTHER_READOUT
    assert readout_ms(warned) == pytest.approx(24.0, abs=2.0)


def test_rows_from_the_bottom_up_are_told_apart() -> None:
    (warned,) = flown(-0.02)
    assert warned.what == ROLLING and "bottom up" in warned.detail


@pytest.mark.parametrize("stated_ms", [None, 25.0])
def test_nothing_is_said_of_a_global_shutter_or_a_right_readout(stated_ms: float | None) -> None:
    assert flown(0.0, stated_ms) == []
