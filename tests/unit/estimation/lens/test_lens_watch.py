"""A focal length that is stated wrongly shows in turns, in the air and by hand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from companion.estimation.inertial.steady_level import SteadyLevel
from companion.estimation.inertial.turn_integral import TurnIntegral
from companion.estimation.lens.lens_watch import LENS_FITS, OTHER_LENS, LensWatch
from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose, rotation_from_vector, yaw_rotation
from companion.messages import Warned
from companion.slam.features.orb_features import Ints, features_of
from companion.slam.features.view import View
from companion.slam.map.sparse_map import SlamMap
from tests.support.flights.scene import DOWN_LOOKING

Path = Callable[[float], Pose]
TRUE = Camera(640, 480, 480.0, 480.0, 320.0, 240.0)
GREY = np.zeros((480, 640), np.uint8)
CORRECTED_S, LATE_NS = 12, 30_000_000
NOISE_PX, NOISE_RAD = 0.5, 3e-4
"""The second of a gyroscope, per root of a second: 0.02 degrees."""
OBLIQUE = DOWN_LOOKING @ rotation_from_vector(np.array([np.radians(35.0), 0.0, 0.0]))


def in_the_air(t_s: float) -> Pose:
    """Weaves over the points and leans, as in gusts."""
    tilt = np.array([0.1 * np.sin(2.1 * t_s), 0.09 * np.sin(1.7 * t_s + 1), 0.0])
    place = np.array([5 * np.sin(0.5 * t_s), 4 * np.cos(0.4 * t_s), -10.0])
    return Pose(yaw_rotation(0.8 * np.sin(0.7 * t_s)) @ rotation_from_vector(tilt), place)


def on_the_spot(t_s: float) -> Pose:
    """To and fro by 29 degrees in a hover."""
    tilt = np.array([0.02 * np.sin(1.3 * t_s), 0.02 * np.sin(1.1 * t_s + 1), 0.0])
    place = np.array([0.1 * np.sin(0.9 * t_s), 0.1 * np.cos(1.1 * t_s), -5.0])
    return Pose(yaw_rotation(0.5 * np.sin(0.8 * t_s)) @ rotation_from_vector(tilt), place)


def by_hand(t_s: float) -> Pose:
    """Turned about all axes at a desk, half a metre to and fro."""
    swing = np.array([0.5 * np.sin(0.9 * t_s), 0.4 * np.sin(1.1 * t_s + 1), 0.0])
    place = np.array([0.3 * np.sin(0.8 * t_s), 0.2 * np.cos(1.3 * t_s), -1.2])
    return Pose(yaw_rotation(0.6 * np.sin(0.5 * t_s)) @ rotation_from_vector(swing), place)


class Gyroscopes(SteadyLevel):
    """Tell the turns of a path; their stamps are late."""

    def __init__(self, path: Path) -> None:
        super().__init__(TurnIntegral())
        self._path, self._rng = path, np.random.default_rng(8)

    def turn(self, from_ns: int, to_ns: int) -> tuple[Array, float]:
        """See `SteadyLevel`."""
        first, last = (self._path((t_ns - LATE_NS) * 1e-9).rotation for t_ns in (from_ns, to_ns))
        sigma_rad = NOISE_RAD * ((to_ns - from_ns) * 1e-9) ** 0.5
        noise = rotation_from_vector(self._rng.normal(scale=sigma_rad, size=3))
        return first.T @ last @ noise, sigma_rad


def wrong_of(*arguments: Any, **named: Any) -> list[Warned]:
    """The same, without good news."""
    return [each for each in said_of(*arguments, **named) if not each.good]


def said_of(
    stated: float, path: Path = in_the_air, relief_m: float = 3.0, seconds: float = 40.0,
    mount_rad: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> list[Warned]:  # fmt: skip
    """What is said of a camera whose focal length is stated as so many times the true one.

    Its mount is off by a rotation vector, and corrected after `CORRECTED_S`.
    """
    rng = np.random.default_rng(7)
    camera = replace(TRUE, fx=TRUE.fx * stated, fy=TRUE.fy * stated)
    watch, slam_map = LensWatch(camera, Gyroscopes(path)), SlamMap(1.2, 8)
    wide = 22.0 if path is in_the_air else 3.0
    points = np.c_[rng.uniform(-wide, wide, (900, 2)), rng.uniform(-relief_m, 0, 900)]
    said: list[Warned] = []
    for k in range(int(seconds * 15)):
        off = rotation_from_vector(np.array(mount_rad) * (k < 15 * CORRECTED_S))
        body = path(k / 15)
        pixels = TRUE.project(
            Pose(body.rotation @ OBLIQUE, body.translation).inverse().apply(points)
        )
        pixels = pixels + rng.normal(scale=NOISE_PX, size=pixels.shape)
        with np.errstate(invalid="ignore"):
            ids = np.flatnonzero(((pixels > 5) & (pixels < [635, 475])).all(1))
        said += watch.end(view_of(camera, pixels[ids], ids, k), slam_map, OBLIQUE @ off, LATE_NS)
    return said


def view_of(camera: Camera, pixels: Array, ids: Ints, k: int) -> View:
    n = len(ids)
    features = features_of(
        camera, 1.2, pixels.astype(np.float32), camera.normalise(pixels), np.zeros(n, np.int64),
        np.zeros(n, np.float32), np.zeros((n, 32), np.uint8),
    )  # fmt: skip
    t_ns = k * 1_000_000_000 // 15
    return View(k, t_ns, features, None, GREY, Pose.identity(), ids)


@pytest.mark.parametrize("stated", [0.9, 1.1])
@pytest.mark.parametrize(
    ("path", "relief_m"), [(in_the_air, 3.0), (in_the_air, 0.0), (by_hand, 0.6)]
)
def test_ten_percent_are_said_once(stated: float, path: Path, relief_m: float) -> None:
    (warned,) = said_of(stated, path, relief_m)
    assert warned.what == OTHER_LENS
    ratio = float(warned.detail.split("be ")[1].split(" ")[0])
    assert ratio == pytest.approx(1.0 / stated, abs=0.04)


@pytest.mark.parametrize(("stated", "n_said"), [(0.9, 1), (1.0, 0), (1.1, 1)])
def test_a_turn_on_the_spot_tells_it(stated: float, n_said: int) -> None:
    """A camera that sways by decimetres only: other focal lengths fit nearly as well."""
    assert len(wrong_of(stated, on_the_spot, relief_m=0.0, seconds=10.0)) == n_said


def test_it_is_said_after_seconds_of_turning() -> None:
    """Before a map that bends by it is left: a lens is not flown on until then."""
    assert said_of(1.1, by_hand, 0.6, seconds=6.0)


@pytest.mark.parametrize("stated", [0.98, 1.0, 1.02])
@pytest.mark.parametrize("path", [in_the_air, by_hand])
def test_nothing_is_said_of_two_percent(stated: float, path: Path) -> None:
    assert not wrong_of(stated, path)


@pytest.mark.parametrize("path", [in_the_air, by_hand])
def test_turns_prove_it_once(path: Path) -> None:
    (warned,) = said_of(1.0, path)
    assert warned.what == LENS_FITS and warned.good


@pytest.mark.parametrize("stated", [0.95, 1.05])
def test_five_percent_are_not_proven(stated: float) -> None:
    assert LENS_FITS not in {each.what for each in said_of(stated, by_hand, 0.6)}


@pytest.mark.parametrize("mount_rad", [(0.14, 0.0, 0.0), (0.084, 0.09, 0.067)])
def test_turns_told_by_a_wrong_mount_do_not_count(mount_rad: tuple[float, float, float]) -> None:
    """Of 8 degrees: they make the focal length look 10 to 16 % longer."""
    assert wrong_of(1.0, seconds=30.0, mount_rad=mount_rad) == []


def test_nothing_is_said_without_turns() -> None:
    assert not said_of(0.9, lambda t_s: Pose(np.eye(3), in_the_air(t_s).translation))
