"""Edges of a board in an image: corners to a fraction of a pixel, and how sharp it is."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.geometry.transforms import Array
from companion.messages import Bytes


def refined_corners(grey: Bytes, image_px: Array, columns: int) -> Array:
    """Sub-pixel corners, from windows that contain their edges only."""
    grid = image_px.reshape(-1, columns, 2)
    gap_px = min(
        float(np.linalg.norm(np.diff(grid, axis=0), axis=-1).min()),
        float(np.linalg.norm(np.diff(grid, axis=1), axis=-1).min()),
    )
    half = int(np.clip(0.3 * gap_px, 2, 12))
    corners = image_px.astype(np.float32).reshape(-1, 1, 2)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 40, 0.001)
    refined = cv2.cornerSubPix(grey, corners, (half, half), (-1, -1), stop)
    return np.asarray(refined, np.float64).reshape(-1, 2)


def edge_px(grey: Bytes, ids: NDArray[np.int64], image_px: Array, columns: int) -> float:
    """Contrast over steepest slope, across edges between neighbouring corners.

    Motion blur is directional, so both directions are measured, and the larger width counts. nan
    without neighbouring corners.
    """
    place = {int(number): at for at, number in enumerate(ids)}
    widths = []
    for step in (1, columns):
        pairs = [
            (place[number], place[number + step])
            for number in place
            if number + step in place and (step > 1 or (number + 1) % columns)
        ]
        if pairs:
            widths.append(_edge_width(grey, image_px[np.array(pairs)]))
    return max(widths) if widths else math.nan


def _edge_width(grey: Bytes, ends_px: Array) -> float:
    """Median over edges with these end points, (N, 2, 2)."""
    along = ends_px[:, 1] - ends_px[:, 0]
    length = np.linalg.norm(along, axis=1)
    across = np.stack([-along[:, 1], along[:, 0]], 1) / length[:, None]
    reach_px = float(np.clip(0.25 * np.median(length), 2.0, 15.0))
    offsets = np.arange(-reach_px, reach_px + 1e-6, 0.5)
    at = np.array([0.4, 0.5, 0.6])
    middles = ends_px[:, 0, None] + at[:, None] * along[:, None]  # (N, 3, 2)
    samples = middles[:, :, None] + offsets[:, None] * across[:, None, None]
    flat = samples.reshape(-1, len(offsets), 2).astype(np.float32)
    bright = np.asarray(
        cv2.remap(grey, flat[..., 0], flat[..., 1], cv2.INTER_LINEAR,
                  borderMode=cv2.BORDER_REPLICATE),
        np.float64,
    ).reshape(len(ends_px), 3, -1).mean(1)  # fmt: skip
    slope = np.abs(bright[:, 2:] - bright[:, :-2]).max(1)  # samples are half a pixel apart
    contrast = np.percentile(bright.max(1), 75) - np.percentile(bright.min(1), 25)
    return float(np.median(contrast / np.maximum(slope, 1e-3)))
