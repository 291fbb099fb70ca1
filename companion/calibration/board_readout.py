"""Readout of a rolling shutter, from a board that moves before the camera.

A corner is exposed with its row: it is seen where the board is a part of the readout before or
after mid-exposure. Its velocity in the image comes from the board's poses in the images before and
after. The readout is then the only unknown of a linear least-squares problem, once each view's pose
is eliminated: a pose can explain shift and scale of the board in the image, not its shear.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from companion.calibration.board_image import project_corners
from companion.calibration.board_pose import board_pose, refined_pose
from companion.calibration.board_views import View
from companion.calibration.lens_fit import LensFit
from companion.geometry.transforms import Array

MAX_SPAN_NS = 150_000_000
"""Longest time from the image before to the one after: a hand that moves the board to and fro, up
to twice a second, has an even velocity for so long."""
MAX_UNEVEN = 0.25
"""Share of that time by which the image between may be off its middle."""
MIN_MOTION_PX = 8.0
"""Least motion of the corners (median) in that time: poses are uncertain by some tenths of a pixel,
which is then a few hundredths of the velocity."""
MIN_VIEWS = 10
MAX_SIGMA_MS = 1.0
"""Largest standard deviation of a readout that is written: in a turn of a radian per second, a
millisecond moves what a lens of 500 pixels sees by half a pixel, as much as the noise of a corner.
"""
SIGNIFICANT = 3.0
"""Standard deviations from zero below which the shutter counts as global."""
HUBER_SIGMAS = 2.0
N_ROUNDS = 10
"""Of the robust weights."""
N_PASSES = 3
"""In each, the readout so far is undone before the poses are fitted."""


@dataclass(frozen=True, slots=True)
class TimedView:
    """A view and the time of its image."""

    t_ns: int
    view: View


@dataclass(frozen=True, slots=True)
class BoardReadout:
    """Readout of the sensor from its top to its bottom row, as measured on a moved board."""

    measured_ms: float
    sigma_ms: float
    n_views: int

    @property
    def is_significant(self) -> bool:
        """True of a rolling shutter, however uncertain its readout."""
        return abs(self.measured_ms) > SIGNIFICANT * self.sigma_ms

    def is_as(self, other: BoardReadout) -> bool:
        """True if both are the same but for a standard deviation."""
        return abs(self.measured_ms - other.measured_ms) < self.sigma_ms

    @property
    def is_upward(self) -> bool:
        """True if the bottom row is read first, as where a driver turns the image upside down."""
        return self.is_significant and self.measured_ms < 0

    @property
    def readout_ms(self) -> float | None:
        """Readout, 0 of a global shutter; None where it is uncertain, or from the bottom up."""
        if self.sigma_ms > MAX_SIGMA_MS or self.is_upward:
            return None
        return self.measured_ms if self.is_significant else 0.0


def measured_readout(
    lens: LensFit, views: Sequence[TimedView]
) -> tuple[BoardReadout, dict[int, View]] | None:
    """Readout by views in order of time; the views by number, with the readout undone in each.

    None where the board moves in fewer than `MIN_VIEWS`.
    """
    found: BoardReadout | None = None
    undone: dict[int, View] = {}
    posed = [
        _PosedView(each.t_ns, each.view, each.view, pose)
        for each in views
        if (pose := board_pose(each.view, lens.model, lens.parameters)) is not None
    ]
    if len(posed) < MIN_VIEWS:
        return None
    for _ in range(N_PASSES):
        moved = [
            _moved(lens, before, now, after)
            for before, now, after in zip(
                [None, *posed[:-1]], posed, [*posed[1:], None], strict=True
            )
        ]
        terms = [
            _term(lens, view, by_s)
            for view, (by_s, is_even) in zip(posed, moved, strict=True)
            if is_even
        ]
        if len(terms) < MIN_VIEWS:
            return None
        found = _fitted(terms, 0.0 if found is None else 1e-3 * found.measured_ms)
        for each, (by_s, _) in zip(posed, moved, strict=True):
            seen_px = each.view.detection.image_px - 1e-3 * found.measured_ms * by_s
            each.undone = replace(
                each.view, detection=replace(each.view.detection, image_px=seen_px)
            )
            each.pose = refined_pose(each.undone, lens.model, lens.parameters, each.pose)
            undone[each.view.number] = each.undone
    return None if found is None else (found, undone)


@dataclass(slots=True, eq=False)
class _PosedView:
    t_ns: int
    view: View
    undone: View
    """As a global shutter would see it, by the readout so far."""
    pose: Array


def _moved(
    lens: LensFit, before: _PosedView | None, now: _PosedView, after: _PosedView | None
) -> tuple[Array, bool]:
    """Motion (N, 2) of the corners in a second of readout, and whether it can measure one.

    It can where the images before and after are near enough, and the board moves enough. With one
    of them alone the motion is good enough to undo the readout.
    """
    corners = partial(project_corners, now.view, lens.model, lens.parameters)
    near = [
        each
        for each in (before, after)
        if each is not None and abs(each.t_ns - now.t_ns) <= MAX_SPAN_NS // 2
    ]
    if not near:
        return np.zeros_like(now.view.detection.image_px), False
    first, last = (near[0], near[1]) if len(near) == 2 else sorted((near[0], now), key=_time)
    span_ns = last.t_ns - first.t_ns
    uneven_ns = abs(first.t_ns + last.t_ns - 2 * now.t_ns)
    moved_px = corners(last.pose)[0] - corners(first.pose)[0]
    rows = now.view.detection.image_px[:, 1] / (now.view.height - 1) - 0.5
    by_s = moved_px / (1e-9 * max(span_ns, 1)) * rows[:, None]
    if span_ns <= 0 or not np.isfinite(by_s).all():
        return np.zeros_like(by_s), False
    quick = float(np.median(np.linalg.norm(moved_px, axis=1))) >= MIN_MOTION_PX
    return by_s, quick and len(near) == 2 and uneven_ns <= MAX_UNEVEN * span_ns


def _time(view: _PosedView) -> int:
    return view.t_ns


def _term(lens: LensFit, view: _PosedView, by_s: Array) -> tuple[float, float]:
    """Products, of what a second of readout moves in a view, with the residual and with itself."""
    seen_px, _, by_pose = project_corners(view.view, lens.model, lens.parameters, view.pose)
    by_readout = by_s.reshape(-1)
    by_readout = by_readout - by_pose @ np.linalg.lstsq(by_pose, by_readout, rcond=None)[0]
    residual = (view.undone.detection.image_px - seen_px).reshape(-1)
    return float(by_readout @ residual), float(by_readout @ by_readout)


def _fitted(terms: Sequence[tuple[float, float]], undone_s: float) -> BoardReadout:
    """Readout by the terms of views from which `undone_s` of it has been undone."""
    by_both, by_itself = np.array(terms).T
    weights = np.ones(len(terms))
    readout_s = variance = 0.0
    for _ in range(N_ROUNDS):
        total = float(weights @ by_itself)
        readout_s = float(weights @ by_both) / total
        off = by_both - readout_s * by_itself
        # from the scatter of the views, for it holds an uneven motion of the board too
        variance = float((weights * off) @ (weights * off)) / total**2
        off = np.abs(off) / np.sqrt(by_itself)
        spread = max(1.4826 * float(np.median(off)), 1e-12)
        weights = np.minimum(1.0, HUBER_SIGMAS * spread / np.maximum(off, 1e-12))
    return BoardReadout(1e3 * (undone_s + readout_s), 1e3 * float(np.sqrt(variance)), len(terms))


def fastest_moved(middles_px: Sequence[tuple[int, Array]], n: int) -> list[int]:
    """Numbers of at most `n` images, in order, about which the board moves fastest.

    `middles_px` are numbers of images, in order, and the middle of the board in each.
    """
    speeds = [
        (float(np.linalg.norm(after - before)) / (later - earlier), number)
        for (earlier, before), (number, _), (later, after) in zip(
            middles_px, middles_px[1:], middles_px[2:], strict=False
        )
    ]
    return sorted(number for _, number in sorted(speeds, reverse=True)[:n])
