"""Acceptance of a calibration, and advice to improve it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from companion.calibration.board_views import MIN_COVERAGE, Coverage, View
from companion.calibration.lens_calibration import Calibration, folds
from companion.geometry.transforms import Array

MIN_VIEWS = 12
MAX_REJECTED = 0.25
"""Ratio of the chosen views."""
MAX_SAG = 0.01
"""Relative to the longer side of the board; smaller sags are modelled."""
MIN_TILT = 0.3
"""Sine of the angle between board and image plane: about 17 degrees."""
MIN_TILTED = 4
MAX_RMS_PX, MAX_RMS_RATIO = 0.7, 0.0006
"""Larger errors, in pixels and relative to the image width, are due to a deformed or wrong board.
"""
MAX_HOLDOUT = 1.5
"""Relative to the largest error allowed."""
MAX_SIGMA_FOCAL = 0.005
"""Relative to the focal length."""
MAX_SIGMA_CENTRE = 0.005
"""Relative to the image width."""


def faults(calibration: Calibration) -> list[str]:
    """Reasons for rejection, each with advice; none if accepted."""
    camera = calibration.camera
    out = []
    n = len(calibration.views)
    n_all = n + len(calibration.rejected)
    if len(calibration.rejected) > MAX_REJECTED * n_all:
        out.append(
            f"{len(calibration.rejected)} of {n_all} views fit no lens together with the others: "
            "is the board flat, and is it the one that --board says?"
        )
    limit_px = max_rms_px(camera.width)
    if calibration.rms_px > limit_px:
        out.append(
            f"the reprojection error is {calibration.rms_px:.2f} px (at most {limit_px:.2f}): use "
            "a flat board, more light, and the --model that the lens is of"
        )
    elif calibration.holdout_px > MAX_HOLDOUT * limit_px:
        out.append(
            f"views left out of the fit are {calibration.holdout_px:.2f} px off (at most "
            f"{MAX_HOLDOUT * limit_px:.2f}): take more views, all over the picture"
        )
    if calibration.sag > MAX_SAG:
        out.append(
            f"the board is bowed by {calibration.sag_m * 1000:.1f} mm (at most "
            f"{MAX_SAG * calibration.sag_m / calibration.sag * 1000:.1f}): mount it flat"
        )
    out += too_few_views(n) + low_coverage(calibration.coverage)
    out += too_frontal(calibration.lens.tilts()) or _uncertain(calibration)
    if folds(camera):
        out.append(
            "the lens model folds over within the picture: cover its corners with the board, or "
            "try --model equidistant"
        )
    return out


def max_rms_px(width: int) -> float:
    """Largest reprojection error allowed at an image width."""
    return max(MAX_RMS_PX, MAX_RMS_RATIO * width)


def too_few_views(n_views: int) -> list[str]:
    """Fault of too few views."""
    if n_views >= MIN_VIEWS:
        return []
    number = f"{n_views} views" if n_views != 1 else "1 view"
    return [
        f"only {number} of the board unlike the others (at least {MIN_VIEWS}): show it "
        "in more places, near and far, tilted"
    ]


def low_coverage(covered: Coverage) -> list[str]:
    """Fault of too little coverage."""
    out = []
    corners = covered.uncovered_corners()
    if corners:
        where = f"in the {_and(corners)} corner"
        out.append(f"the board was never {where} of the picture: show it {where}")
    if covered.share < MIN_COVERAGE:
        where = f"at the {covered.least_covered_edge()} edge"
        out.append(
            f"the board covered {covered.share:.0%} of the picture (at least {MIN_COVERAGE:.0%}), "
            f"least {where}: show it {where}"
        )
    return out


def too_frontal(tilts: Array) -> list[str]:
    """Fault of too few tilted views, or about one axis only; `tilts` as `LensFit.tilts`."""
    n_tilted = int((np.linalg.norm(tilts, axis=1) >= MIN_TILT).sum())
    if n_tilted < MIN_TILTED:
        squarely = f"all but {n_tilted}" if n_tilted else "all"
        return [
            f"the board faced the camera squarely in {squarely} views (at least "
            f"{MIN_TILTED} tilted), so that the focal length is not determined: tilt it by 20 to "
            "45 degrees"
        ]
    across, down = np.abs(tilts).max(0)
    if min(across, down) < MIN_TILT:
        way = "its left or right side" if across < down else "its upper or lower side"
        return [f"the board was tilted one way only: tilt it also with {way} to the camera"]
    return []


def advice(views: Sequence[View], covered: Coverage, calibration: Calibration | None) -> str:
    """Next step in front of a live camera, in a few words; "" when complete."""
    if len(views) < 4:
        return "show the board in different places"
    corners = covered.uncovered_corners()
    if corners:
        return f"show it in the {corners[0]} corner"
    if covered.share < MIN_COVERAGE:
        return f"cover the {covered.least_covered_edge()} edge"
    if calibration is not None:
        tilts = calibration.lens.tilts()
        if (np.linalg.norm(tilts, axis=1) >= MIN_TILT).sum() < MIN_TILTED:
            return "tilt the board more"
        if too_frontal(tilts):
            across, down = np.abs(tilts).max(0)
            return f"tilt it {'left and right' if across < down else 'forward and back'}"
    if len(views) < MIN_VIEWS:
        return "more views: near and far, tilted"
    if calibration is None:
        return "more views, held still"
    wrong = faults(calibration)
    return wrong[0].rpartition(": ")[2] if wrong else ""


def _uncertain(calibration: Calibration) -> list[str]:
    camera = calibration.camera
    out = []
    focal = max(calibration.sigmas[0] / camera.fx, calibration.sigmas[1] / camera.fy)
    if focal > MAX_SIGMA_FOCAL:
        by = f"{focal:.1%}" if focal < 0.3 else "a third or more"
        out.append(
            f"the focal length is uncertain by {by} (at most {MAX_SIGMA_FOCAL:.1%}): tilt "
            "the board more, and bring it nearer"
        )
    centre = float(max(calibration.sigmas[2:4])) / camera.width
    if centre > MAX_SIGMA_CENTRE:
        out.append(
            f"the principal point is uncertain by {max(calibration.sigmas[2:4]):.1f} px (at most "
            f"{MAX_SIGMA_CENTRE * camera.width:.1f}): turn and tilt the board more"
        )
    if not (
        0.2 < camera.cx / camera.width < 0.8
        and 0.2 < camera.cy / camera.height < 0.8
        and 0.5 < camera.fx / camera.fy < 2
    ):
        out.append(
            f"no camera is like this (fx {camera.fx:.0f}, fy {camera.fy:.0f}, cx {camera.cx:.0f}, "
            f"cy {camera.cy:.0f}): tilt the board more, all over the picture"
        )
    return out


def _and(words: Sequence[str]) -> str:
    return words[0] if len(words) == 1 else ", ".join(words[:-1]) + " and " + words[-1]
