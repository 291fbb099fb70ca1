"""Views of the board: quality, selection, image coverage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.calibration.chart import Detection
from companion.geometry.transforms import Array
from companion.messages import Bytes

MIN_NOVELTY = 0.03
"""RMS corner distance below which views count as equal, relative to the image diagonal."""
MIN_AREA = 0.01
"""Ratio of the image area covered by the board."""
MAX_EDGE_PX, MAX_EDGE_RATIO = 3.5, 0.003
"""Wider edges, in pixels and relative to the diagonal, are blurred by motion or defocus."""
GRID_ACROSS = 64
"""Columns of the coverage map."""
CORNER_BOX = 0.22
"""Side of the box in each image corner that the board must reach, as a ratio."""
MIN_BOX_COVERED = 0.15
MIN_COVERAGE = 0.60
MAX_DARK_GREY = 16
"""Cells never brighter than this are outside the image circle."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """The board in one image."""

    number: int
    """Index of the image in its source."""
    detection: Detection
    width: int
    height: int

    @property
    def n_corners(self) -> int:
        """Number of corners found."""
        return len(self.detection.ids)

    @property
    def diagonal_px(self) -> float:
        """Image diagonal."""
        return float(np.hypot(self.width, self.height))

    @property
    def area(self) -> float:
        """Ratio of the image within the outermost corners."""
        return float(cv2.contourArea(_hull(self))) / (self.width * self.height)

    @property
    def blurred(self) -> bool:
        """True if edges are too wide for accurate corners."""
        limit_px = max(MAX_EDGE_PX, MAX_EDGE_RATIO * self.diagonal_px)
        return self.detection.edge_px > limit_px

    @property
    def small(self) -> bool:
        """True if the board fills too small a part of the image."""
        return self.area < MIN_AREA


def novelty(view: View, others: Sequence[View]) -> float:
    """Smallest RMS corner distance to other views, relative to the diagonal; 1 without any.

    Translation, rotation and tilt of the board all count.
    """
    return min((_distance(view, other) for other in others), default=1.0)


def choose(views: Sequence[View], n: int) -> list[View]:
    """At most `n` distinct views of largest coverage, ordered by number."""
    if not views:
        return []
    masks = [_mask(view) for view in views]
    covered = np.zeros_like(masks[0])
    nearest = np.ones(len(views))
    edges = np.array([view.detection.edge_px for view in views])
    bluntness = np.nan_to_num(edges / max(float(np.nanmin(edges)), 1e-6) - 1, nan=1.0)
    taken: list[int] = []
    while len(taken) < n:
        gain = np.array([float((mask & ~covered).mean()) for mask in masks])
        score = np.minimum(nearest, 0.3) + gain - 0.02 * bluntness
        score[nearest < MIN_NOVELTY] = -np.inf
        best = int(np.argmax(score))
        if not np.isfinite(score[best]):
            break
        taken.append(best)
        covered |= masks[best]
        distances = [_distance(view, views[best]) for view in views]
        nearest = np.minimum(nearest, distances)
    return [views[i] for i in sorted(taken)]


class IlluminatedArea:
    """Area within the image circle of a fisheye."""

    def __init__(self) -> None:
        self._brightest: Bytes | None = None

    def see(self, grey: Bytes) -> None:
        """Add an image."""
        height, width = grey.shape
        small = np.asarray(
            cv2.resize(grey, grid_size(width, height), interpolation=cv2.INTER_AREA), np.uint8
        )
        before = self._brightest
        self._brightest = small if before is None else np.maximum(before, small)

    def mask(self, width: int, height: int) -> Mask:
        """Cells of the coverage map that can show a board."""
        across, down = grid_size(width, height)
        if self._brightest is None:
            return np.ones((down, across), np.bool_)
        return self._brightest > MAX_DARK_GREY


def grid_size(width: int, height: int) -> tuple[int, int]:
    """Columns and rows of the coverage map for an image size."""
    return GRID_ACROSS, max(4, round(GRID_ACROSS * height / width))


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """Coverage map of the board, and the illuminated cells."""

    seen: Mask
    lit: Mask

    @property
    def share(self) -> float:
        """Covered ratio of the illuminated area."""
        return float((self.seen & self.lit).sum() / max(self.lit.sum(), 1))

    def uncovered_corners(self) -> list[str]:
        """Image corners that the board never reached."""
        down, across = self.seen.shape
        rows, columns = round(CORNER_BOX * down), round(CORNER_BOX * across)
        out = []
        for row, upper in ((slice(0, rows), "upper"), (slice(down - rows, down), "lower")):
            for column, left in (
                (slice(0, columns), "left"),
                (slice(across - columns, across), "right"),
            ):
                lit = self.lit[row, column]
                if lit.mean() > 0.5 and self.seen[row, column][lit].mean() < MIN_BOX_COVERED:
                    out.append(f"{upper} {left}")
        return out

    def least_covered_edge(self) -> str:
        """Side of the image with least coverage."""
        down, across = self.seen.shape
        sides: dict[str, tuple[slice, slice]] = {
            "left": (slice(None), slice(0, across // 4)),
            "right": (slice(None), slice(across - across // 4, across)),
            "upper": (slice(0, down // 4), slice(None)),
            "lower": (slice(down - down // 4, down), slice(None)),
        }
        shares = {
            name: float(self.seen[at][self.lit[at]].mean()) if self.lit[at].any() else 1.0
            for name, at in sides.items()
        }
        return min(shares, key=lambda name: shares[name])


def coverage(views: Sequence[View], lit: Mask) -> Coverage:
    """Coverage by the convex hulls of the corners of views."""
    seen = np.zeros_like(lit)
    for view in views:
        seen |= _mask(view)
    return Coverage(seen, lit)


def _distance(one: View, other: View) -> float:
    _, mine, theirs = np.intersect1d(
        one.detection.ids, other.detection.ids, assume_unique=True, return_indices=True
    )
    if len(mine) < 4:
        return 1.0
    difference_px: Array = one.detection.image_px[mine] - other.detection.image_px[theirs]
    return min(1.0, float(np.sqrt((difference_px**2).sum(1).mean())) / one.diagonal_px)


def _hull(view: View) -> NDArray[np.float32]:
    return np.asarray(cv2.convexHull(view.detection.image_px.astype(np.float32)), np.float32)


def _mask(view: View) -> Mask:
    across, down = grid_size(view.width, view.height)
    scale = np.array([across / view.width, down / view.height])
    cells = (_hull(view).reshape(-1, 2) + 0.5) * scale - 0.5
    mask = np.zeros((down, across), np.uint8)
    cv2.fillConvexPoly(mask, cells.round().astype(np.int32), 1)
    return mask.astype(np.bool_)
