"""Surface model: rasters of height and colour of the uppermost surface in each grid cell."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from companion.errors import InputError
from companion.geometry.transforms import Array
from companion.messages import Bytes, Floats
from companion.products.cloud import Cloud
from companion.products.export.map_frame import MapFrame

UPPER_SHARE = 0.75
"""Quantile of the heights in a cell taken as its surface: above most points, below outliers."""
MAX_CELLS = 100_000_000
N_SPACING = 2000
N_SIDE = 100
"""Parts along the longer side of the area, each with one point in the spacing."""
CELLS_PER_SPACING = 2.0
MIN_NEIGHBOURS = 3
FILL_STEPS = 2
"""Holes up to twice this many cells wide are filled from their border."""


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Rasters with north up: `height` (H, W) f32, nan where none; `rgb` (H, W, 3); `seen` (H, W).

    `west`, `north` is the outer corner of the first cell, all in the map's metres; `seen` is False
    for interpolated cells.
    """

    height: Floats
    rgb: Bytes
    seen: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]
    west: float
    north: float
    cell_m: float


def surface_of(cloud: Cloud, frame: MapFrame, cell_m: float) -> Surface:
    """Grid the cloud; `cell_m` 0 takes twice the spacing of its points.

    InputError where there are no points, or too many cells.
    """
    if len(cloud) < 4:
        raise InputError("the cloud has next to no points: no surface can be made of it")
    points = frame.coordinates(cloud.points.astype(np.float64))
    cell = cell_m or float(f"{_spacing(points) * CELLS_PER_SPACING:.2g}")
    west, south = np.floor(points[:, :2].min(0) / cell) * cell
    north = float(np.floor(points[:, 1].max() / cell) * cell + cell)
    width = int((points[:, 0].max() - west) / cell) + 1
    height = round((north - south) / cell)
    if width * height > MAX_CELLS:
        raise InputError(
            f"a grid of {width} x {height} cells of {cell:g} m is too large: set "
            "expert.export.cell_m larger"
        )
    column = np.minimum((points[:, 0] - west) / cell, width - 1).astype(np.int64)
    row = np.clip((north - points[:, 1]) / cell, 0, height - 1).astype(np.int64)
    index = row * width + column
    order = np.lexsort((points[:, 2], index))
    cells, first, count = np.unique(index[order], return_index=True, return_counts=True)
    chosen = order[first + np.floor(UPPER_SHARE * (count - 1)).astype(np.int64)]
    heights = np.full(width * height, np.nan, np.float32)
    heights[cells] = points[chosen, 2].astype(np.float32)
    rgb = np.zeros((width * height, 3), np.uint8)
    rgb[cells] = cloud.rgb[chosen]
    grid, colours = heights.reshape(height, width), rgb.reshape(height, width, 3)
    seen = np.isfinite(grid)
    filled, coloured = _filled(grid, colours)
    return Surface(filled, coloured, seen, float(west), north, float(cell))


def _spacing(points: Array) -> float:
    """Median distance of neighbours in plan view, each part of the area counting alike.

    The points of walls lie on lines there: most of a cloud of buildings, on next to no area.
    """
    flat = points[:, :2]
    side = max(float(np.ptp(np.percentile(flat, [1, 99], axis=0), axis=0).max()) / N_SIDE, 1e-3)
    _, first = np.unique(np.floor(flat / side).astype(np.int64), axis=0, return_index=True)
    sample = flat[first[:: max(1, len(first) // N_SPACING)]]
    distance, _ = cKDTree(flat).query(sample, k=2)
    return max(float(np.median(distance[:, 1])), 1e-3)


def _filled(height: Floats, rgb: Bytes) -> tuple[Floats, Bytes]:
    """Cells without points that have enough neighbours take their mean, a few iterations."""
    colours = rgb.astype(np.float32)
    for _ in range(FILL_STEPS):
        known = np.isfinite(height)
        n = _sums(known.astype(np.float32))
        wanted = ~known & (n >= MIN_NEIGHBOURS)
        level = _sums(np.where(known, height, 0).astype(np.float32)) / np.maximum(n, 1)
        mixed = _sums(np.where(known[..., None], colours, 0)) / np.maximum(n, 1)[..., None]
        height = np.where(wanted, level, height).astype(np.float32)
        colours = np.where(wanted[..., None], mixed, colours)
    return height, np.rint(colours).astype(np.uint8)


def _sums(values: Floats) -> Floats:
    """Sum of each cell with its eight neighbours."""
    summed = cv2.filter2D(values, -1, np.ones((3, 3)), borderType=cv2.BORDER_CONSTANT)
    return np.asarray(summed, np.float32)
