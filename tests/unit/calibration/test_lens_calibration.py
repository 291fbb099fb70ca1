"""Calibration of known lenses from rendered boards."""

from __future__ import annotations

import dataclasses
from functools import cache

import cv2
import numpy as np
import pytest

from companion.calibration.board_views import (
    Coverage,
    IlluminatedArea,
    View,
    choose,
    coverage,
    novelty,
)
from companion.calibration.calibration_verdict import (
    MIN_TILT,
    advice,
    faults,
    low_coverage,
    too_few_views,
    too_frontal,
)
from companion.calibration.chart import parse_chart
from companion.calibration.lens_calibration import Calibration, calibrate_lens, folds
from companion.geometry.camera import Camera
from companion.geometry.transforms import Array
from tests.support.cameras.board_pictures import (
    CHARUCO,
    CHESSBOARD,
    FISHEYE,
    RADTAN,
    BoardPictures,
    Placing,
    well_shown,
)


@cache
def found(camera: Camera, board: str, bend: float) -> tuple[tuple[View, ...], IlluminatedArea]:
    lit, views = IlluminatedArea(), []
    chart = parse_chart(board)
    for number, grey in enumerate(well_shown(camera, board, bend)):
        lit.see(grey)
        detection = chart.find(grey)
        if detection is not None:
            views.append(View(number, detection, camera.width, camera.height))
    return tuple(views), lit


@cache
def calibrated(camera: Camera, board: str, model: str, bend: float = 0.0) -> Calibration:
    views, lit = found(camera, board, bend)
    made = calibrate_lens(choose(views, 40), lit.mask(camera.width, camera.height), model)
    assert made is not None
    return made


def lens_of(camera: Camera) -> Array:
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy])


@pytest.mark.parametrize(
    ("camera", "board", "model"),
    [(RADTAN, CHARUCO, "auto"), (RADTAN, CHESSBOARD, "radtan"), (FISHEYE, CHARUCO, "auto")],
)
def test_lens_is_recovered(camera: Camera, board: str, model: str) -> None:
    made = calibrated(camera, board, model)
    assert made.camera.distortion is camera.distortion
    error = np.abs(lens_of(made.camera) - lens_of(camera))
    assert (error[:2] < 0.003 * lens_of(camera)[:2]).all(), error
    assert (error[2:] < 1.0).all(), error
    assert made.rms_px < 0.1 and made.holdout_px < 0.1
    # what the lens does to places all over the picture, whatever each coefficient
    rays = camera.normalise(np.array([[60.0, 60], [580, 60], [60, 420], [580, 420], [320, 30]]))
    points = np.concatenate([rays, np.ones((len(rays), 1))], 1)
    assert np.abs(made.camera.project(points) - camera.project(points)).max() < 1.0
    if board == CHARUCO:
        assert not [fault for fault in faults(made) if "corner of" not in fault]


def test_standard_deviations_match_the_errors() -> None:
    made = calibrated(RADTAN, CHARUCO, "auto")
    error = np.abs(lens_of(made.camera) - lens_of(RADTAN)) / made.sigmas[:4]
    assert (error < 4).all(), error
    assert (made.sigmas[:4] < 1.0).all() and (made.sigmas[:4] > 0.05).all()


def test_same_as_opencv_where_the_board_is_flat() -> None:
    made = calibrated(RADTAN, CHARUCO, "auto")
    _, matrix, *_ = cv2.calibrateCamera(
        [view.detection.board_m.astype(np.float32) for view in made.views],
        [view.detection.image_px.astype(np.float32) for view in made.views],
        (640, 480), np.eye(3), np.zeros(5),
        flags=cv2.CALIB_FIX_K3,
    )  # fmt: skip
    theirs = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])
    assert np.abs(lens_of(made.camera) - theirs).max() < 0.5


def test_curved_board_does_not_bias_the_focal_length() -> None:
    made = calibrated(RADTAN, CHARUCO, "radtan", 0.006)
    error = np.abs(lens_of(made.camera) - lens_of(RADTAN))
    assert (error[:2] < 0.003 * lens_of(RADTAN)[:2]).all(), error
    assert 0.002 < made.sag < 0.008


def test_board_with_too_much_curvature() -> None:
    made = calibrated(RADTAN, CHARUCO, "radtan", 0.006)
    assert not faults(made)
    lens = made.lens
    bent = np.concatenate([lens.parameters[:-3], 4 * lens.parameters[-3:]])
    further = dataclasses.replace(made, lens=dataclasses.replace(lens, parameters=bent))
    assert [fault for fault in faults(further) if "bowed" in fault]


def test_radtan_is_rejected_for_a_fisheye() -> None:
    made = calibrated(FISHEYE, CHARUCO, "radtan")
    assert any("error" in fault for fault in faults(made))


def test_inconsistent_views_are_rejected() -> None:
    views = list(found(RADTAN, CHARUCO, 0.0)[0])
    rng = np.random.default_rng(3)
    for at in (4, 11):  # as a picture in which the board moved while its rows were read
        detection = views[at].detection
        sheared = detection.image_px + 0.03 * (detection.image_px[:, 1:] - 240) * [1, 0]
        sheared += rng.normal(0, 1.5, sheared.shape)
        views[at] = dataclasses.replace(
            views[at], detection=dataclasses.replace(detection, image_px=sheared)
        )
    wrong = views[7].detection.image_px.copy()
    wrong[5] += [9.0, -6.0]
    views[7] = dataclasses.replace(
        views[7], detection=dataclasses.replace(views[7].detection, image_px=wrong)
    )
    made = calibrate_lens(views, np.ones((48, 64), np.bool_), "radtan")
    assert made is not None
    assert {view.number for view in made.rejected} == {views[4].number, views[11].number}
    assert made.n_corners_rejected == 1
    assert np.abs(lens_of(made.camera) - lens_of(RADTAN)).max() < 1.6


def test_non_invertible_lens_is_detected() -> None:
    assert not folds(RADTAN)
    strong = dataclasses.replace(RADTAN, coefficients=(-0.7, 0.0, 0.0, 0.0, 0.0))
    assert folds(strong)


def test_duplicate_view_is_not_novel() -> None:
    views = found(RADTAN, CHARUCO, 0.0)[0]
    assert novelty(views[3], views[:3]) > 0.03
    assert novelty(views[3], views[:4]) == 0.0
    assert len(choose([views[0]] * 9, 40)) == 1
    few_views = choose(views, 6)
    assert len(few_views) == 6
    lit = np.ones((48, 64), np.bool_)
    first = coverage(views[:6], lit).share
    assert coverage(few_views, lit).share > first


def test_blur_widens_edges() -> None:
    pictures = BoardPictures(RADTAN)
    chart = parse_chart(CHARUCO)
    placing = Placing(0.5, 0.5, 0.55, 10, 15, 5)
    sharp = chart.find(pictures.picture(placing))
    moved = chart.find(pictures.picture(placing, blur_px=5))
    assert sharp is not None and moved is not None
    assert sharp.edge_px < 2.6 and moved.edge_px > 4.2
    assert not View(0, sharp, 640, 480).blurred
    assert View(0, moved, 640, 480).blurred


def test_dark_corners_of_a_fisheye_need_no_coverage() -> None:
    lit = np.ones((48, 64), np.bool_)
    seen = lit.copy()
    seen[:12, :16] = False
    assert Coverage(seen, lit).uncovered_corners() == ["upper left"]
    lit[:12, :16] = False
    assert Coverage(seen, lit).uncovered_corners() == []
    assert Coverage(seen, lit).share == 1.0


def test_missing_views_are_reported() -> None:
    lit = np.ones((48, 64), np.bool_)
    left = lit.copy()
    left[:, 40:] = False
    assert "upper right and lower right" in low_coverage(Coverage(left, lit))[0]
    middle = lit.copy()
    middle[:, :13] = False
    middle[20:, 13:40] = False
    assert any("left edge" in line for line in low_coverage(Coverage(middle, lit)))
    assert "3 views" in too_few_views(3)[0] and too_few_views(12) == []
    square = np.full((12, 2), 0.05)
    assert "squarely in all views" in too_frontal(square)[0]
    square[:5, 0] = MIN_TILT + 0.1
    assert "upper or lower side" in too_frontal(square)[0]
    square[5, 1] = -MIN_TILT - 0.1
    assert too_frontal(square) == []


def test_advice_is_empty_when_complete() -> None:
    views, lit = found(RADTAN, CHARUCO, 0.0)
    covered = coverage(views, lit.mask(640, 480))
    assert advice(views[:2], coverage(views[:2], covered.lit), None)
    assert "corner" in advice(views[:5], coverage(views[:5], covered.lit), None)
    assert "more views" in advice(views, covered, None)
    found_now = calibrated(RADTAN, CHARUCO, "auto")
    assert advice(views, covered, found_now) == ""
    unsure = dataclasses.replace(found_now, sigmas=50.0 * found_now.sigmas)
    assert advice(views, covered, unsure) == "tilt the board more, and bring it nearer"
