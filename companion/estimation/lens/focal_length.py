"""Focal length by turns: how images turn, against how far the gyroscopes have turned.

Of a camera that turns by a known rotation and moves by an unknown translation, points of two images
lie on epipolar lines of each other, wherever in depth they are. With a focal length that is off by
a factor, rays are too, and after a turn across the optical axis they miss these lines by

    (factor - 1) * turn * (products of their coordinates in the image),

which no translation explains. The factor is solved for together with the direction of translation
for each pair of images, by least squares of Sampson's distance (Hartley and Zisserman 2004, 11.4.3)
with Cauchy's weights. A map is no measure: its points have taken the same error in.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from companion.geometry.transforms import Array
from companion.slam.features.orb_features import Ints

MIN_POINTS = 40
ROUNDS = 6
LEAST_NOISE_PX = 0.1
STEP = 1e-4
"""Of differences: directions and factors."""
BEGINS = 0.0, -0.1, 0.1
"""Factors to begin from: a camera that hardly moves has several that fit about as well, and what
fits best is taken."""
MAX_OFF = 0.4
"""A pair whose factor is off by more has measured nothing."""
SIGMA_PAIR = 0.03
"""Of one pair, however many points: a turn and a way look alike, the more the flatter the scene. In
ten flights pairs of the same flight scatter by 0.02 to 0.08."""


class Rays(NamedTuple):
    """Points of an image: ids (N,) of the map's, and normalised coordinates (N, 2)."""

    ids: Ints
    normalised: Array


def focal_ratio(
    before: Rays, now: Rays, before_from_now: Array, sigma_turn_rad: float, focal_px: float
) -> tuple[float, float] | None:
    """True focal length over the stated one, and its standard deviation, by one turn (3, 3).

    None with too few points in common, or where nothing comes out.
    """
    _, a, b = np.intersect1d(before.ids, now.ids, return_indices=True)
    if len(a) < MIN_POINTS:
        return None
    here, there = before.normalised[a], now.normalised[b]
    known = np.isfinite(here).all(1) & np.isfinite(there).all(1)
    here, there = here[known], there[known]
    if len(here) < MIN_POINTS:
        return None

    found = [_solved(here, there, before_from_now, focal_px, begin) for begin in BEGINS]
    _, off, sigma = min(found)
    if not (np.isfinite(sigma) and abs(off) < MAX_OFF):
        return None
    of_turn = sigma_turn_rad / turn_across_rad(before_from_now)
    return 1.0 + off, float(np.linalg.norm([sigma, of_turn, SIGMA_PAIR]))


def _solved(
    here: Array, there: Array, before_from_now: Array, focal_px: float, off: float
) -> tuple[float, float, float]:
    """Median error, px, what the factor is off by, and its standard deviation, from a beginning."""

    def off_px(towards: Array, off: float) -> Array:
        return _sampson(here / (1.0 + off), there / (1.0 + off), towards, before_from_now) * (
            focal_px * (1.0 + off)
        )

    there_rays = _rays(there / (1.0 + off)) @ before_from_now.T
    lines = np.cross(_rays(here / (1.0 + off)), there_rays)
    towards = np.linalg.eigh(lines.T @ lines)[1][:, 0]
    for _ in range(ROUNDS):
        across = np.linalg.svd(towards[None])[2][1:]
        error_px = off_px(towards, off)
        noise_px = max(LEAST_NOISE_PX, 1.48 * float(np.median(np.abs(error_px))))
        slopes = [off_px(_unit(towards + STEP * each), off) - error_px for each in across]
        jacobian = np.stack([*slopes, off_px(towards, off + STEP) - error_px], 1) / STEP
        weighted = jacobian / (1.0 + (error_px / (2.0 * noise_px)) ** 2)[:, None]
        normal = weighted.T @ jacobian
        try:
            step = np.linalg.solve(normal, -weighted.T @ error_px)
            sigma = noise_px * float(np.sqrt(np.linalg.inv(normal)[2, 2]))
        except np.linalg.LinAlgError:
            return np.inf, off, np.inf
        towards = _unit(towards + step[:2] @ across)
        off = float(np.clip(off + np.clip(step[2], -0.1, 0.1), -MAX_OFF, MAX_OFF))
    return float(np.median(np.abs(off_px(towards, off)))), off, sigma


def turn_across_rad(before_from_now: Array) -> float:
    """Turn of the optical axis: that about it tells nothing of a focal length."""
    return float(np.arccos(np.clip(before_from_now[2, 2], -1.0, 1.0)))


def _rays(normalised: Array) -> Array:
    return np.column_stack([normalised, np.ones(len(normalised))])


def _unit(vector: Array) -> Array:
    out: Array = vector / np.linalg.norm(vector)
    return out


def _sampson(here: Array, there: Array, towards: Array, before_from_now: Array) -> Array:
    """Distances (N,) from epipolar lines, in normalised coordinates."""
    x, y, z = towards
    essential = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ before_from_now
    here_rays, there_rays = _rays(here), _rays(there)
    lines, lines_there = there_rays @ essential.T, here_rays @ essential
    slope = np.sqrt((lines[:, :2] ** 2).sum(1) + (lines_there[:, :2] ** 2).sum(1))
    out: Array = (here_rays * lines).sum(1) / np.maximum(slope, 1e-12)
    return out
