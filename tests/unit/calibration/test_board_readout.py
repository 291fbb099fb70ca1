"""Readout from a moved board: corners of a known shutter, with noise and an uneven motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from companion.calibration.board_image import LensModel
from companion.calibration.board_readout import (
    BoardReadout,
    TimedView,
    fastest_moved,
    measured_readout,
)
from companion.calibration.board_views import IlluminatedArea, View
from companion.calibration.chart import Detection
from companion.calibration.lens_calibration import calibrate_lens
from companion.calibration.lens_fit import LensFit
from companion.calibration.rolling_calibration import calibrate_rolling
from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, rotation_from_vector
from tests.support.cameras.board_pictures import FISHEYE, RADTAN

BOARD_M = np.array([[0.04 * x, 0.04 * y, 0.0] for y in range(4) for x in range(6)]) - [0.1, 0.06, 0]
RATE_HZ = 30.0
LONG_S = 1.6
NOISE_PX = 0.15


def lens_of(camera: Camera) -> LensFit:
    model = LensModel(camera.distortion, len(camera.coefficients))
    parameters = np.array(
        [camera.fx, camera.fy, camera.cx, camera.cy, *camera.coefficients, 0, 0, 0]
    )
    return LensFit(model, camera.width, camera.height, parameters, (), (), (), 0.0)


def pixels_at(camera: Camera, t_s: Array, speed: float) -> Array:
    """Corners (N, 2) of the board, each at its own time (N,), for a hand that moves to and fro."""
    swing = speed * np.sin(2 * np.pi * 1.2 * t_s)
    turn = np.stack([0.2 + 0.5 * swing, 0.3 * np.cos(3 * t_s), 0.8 * swing], 1)
    centre = np.stack(
        [0.25 * swing, 0.12 * speed * np.sin(2 * np.pi * 0.9 * t_s + 1), 0.42 + 0.1 * swing], 1
    )
    points = np.array([rotation_from_vector(r) @ p for r, p in zip(turn, BOARD_M, strict=True)])
    return camera.project(points + centre)


def filmed(
    camera: Camera, readout_s: float, rng: np.random.Generator, speed: float = 0.4
) -> list[TimedView]:
    views = []
    for number in range(round(LONG_S * RATE_HZ)):
        middle_s = number / RATE_HZ
        t_s = np.full(len(BOARD_M), middle_s)
        for _ in range(8):  # a corner is seen by the row that is exposed when it is there
            rows = pixels_at(camera, t_s, speed)[:, 1] / (camera.height - 1) - 0.5
            t_s = middle_s + readout_s * rows
        image_px = pixels_at(camera, t_s, speed) + NOISE_PX * rng.standard_normal((len(t_s), 2))
        found = Detection(np.arange(len(t_s)), image_px, BOARD_M, 2.0)
        view = View(number, found, camera.width, camera.height)
        views.append(TimedView(round(1e9 * middle_s), view))
    return views


def readout_of(lens: LensFit, views: list[TimedView]) -> BoardReadout | None:
    measured = measured_readout(lens, views)
    return None if measured is None else measured[0]


@pytest.mark.parametrize("camera", [RADTAN, FISHEYE], ids=["radtan", "fisheye"])
@pytest.mark.parametrize("readout_ms", [30.0, 5.0])
def test_a_rolling_shutter_is_measured(
    camera: Camera, readout_ms: float, rng: np.random.Generator
) -> None:
    found = readout_of(lens_of(camera), filmed(camera, 1e-3 * readout_ms, rng))
    assert found is not None and found.readout_ms is not None
    assert found.readout_ms == pytest.approx(readout_ms, rel=0.02, abs=3 * found.sigma_ms)
    assert found.sigma_ms < 0.5


def test_a_readout_from_bottom_to_top_is_none(rng: np.random.Generator) -> None:
    found = readout_of(lens_of(RADTAN), filmed(RADTAN, -0.016, rng))
    assert found is not None and found.measured_ms == pytest.approx(-16, abs=1)
    assert found.is_upward and found.readout_ms is None


def test_a_global_shutter_is_known_as_one(rng: np.random.Generator) -> None:
    found = readout_of(lens_of(RADTAN), filmed(RADTAN, 0.0, rng))
    assert found is not None and found.readout_ms == 0.0
    assert abs(found.measured_ms) < 3 * found.sigma_ms < 1.5


def test_a_board_that_hardly_moves_tells_nothing(rng: np.random.Generator) -> None:
    assert readout_of(lens_of(RADTAN), filmed(RADTAN, 0.025, rng, speed=0.02)) is None


def test_images_far_apart_in_time_tell_nothing(rng: np.random.Generator) -> None:
    slow = [replace(each, t_ns=10 * each.t_ns) for each in filmed(RADTAN, 0.025, rng)]
    assert readout_of(lens_of(RADTAN), slow) is None


def test_wrong_corners_in_some_images_change_little(rng: np.random.Generator) -> None:
    views = filmed(RADTAN, 0.025, rng)
    for k in range(5, len(views), 13):
        seen = views[k].view.detection
        wrong = replace(seen, image_px=seen.image_px + 4 * rng.standard_normal(seen.image_px.shape))
        views[k] = TimedView(views[k].t_ns, replace(views[k].view, detection=wrong))
    found = readout_of(lens_of(RADTAN), views)
    assert found is not None and found.measured_ms == pytest.approx(25, abs=1.5)


def test_the_fastest_are_chosen_in_order() -> None:
    x = np.cumsum([0, 1, 1, 9, 9, 1, 1, 1, 20, 20, 1, 1])
    middles = [(2 * k, np.array([float(at), 0.0])) for k, at in enumerate(x)]
    assert fastest_moved(middles, 4) == [6, 14, 16, 18]
    assert fastest_moved(middles[:2], 2) == []


def test_lens_and_readout_are_found_together(rng: np.random.Generator) -> None:
    timed = filmed(RADTAN, 0.025, rng, speed=0.3)
    views = [each.view for each in timed[1:-1:4]]
    lit = IlluminatedArea().mask(RADTAN.width, RADTAN.height)
    as_global = calibrate_lens(views, lit, "radtan")
    assert as_global is not None
    calibration, readout = calibrate_rolling(views, timed, lit, "radtan", as_global)
    assert readout is not None and readout.measured_ms == pytest.approx(25, rel=0.02)
    assert calibration.rms_px < 1.5 * NOISE_PX * np.sqrt(2) < as_global.rms_px
    off_px = [abs(made.camera.fx - RADTAN.fx) for made in (as_global, calibration)]
    assert off_px[1] < min(3 * calibration.sigmas[0], 0.5 * off_px[0])


def test_without_motion_the_calibration_stays(rng: np.random.Generator) -> None:
    timed = filmed(RADTAN, 0.025, rng)
    slow = [replace(each, t_ns=10 * each.t_ns) for each in timed]
    views = [each.view for each in timed[::5]]
    lit = IlluminatedArea().mask(RADTAN.width, RADTAN.height)
    made = calibrate_lens(views, lit, "radtan")
    assert made is not None
    assert calibrate_rolling(views, slow, lit, "radtan", made) == (made, None)
