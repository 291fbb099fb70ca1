"""Pictures of the cloud: points splatted into a depth buffer, orthographic."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.geometry.transforms import Array
from companion.geometry.voxel import distinct_cells
from companion.messages import Bytes, Floats
from companion.products.cloud import Cloud

WIDTH_PX = 1100
FINER = 2
"""Supersampling factor of views, for smooth edges."""
MAX_SPLAT_PX = 25
OBLIQUE_DOWN_RAD = np.radians(35)
COMPASS = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")


@dataclass(frozen=True, slots=True, eq=False)
class CloudView:
    """A picture (WebP, transparent where empty) and its overlay in pixels.

    `paths` are polylines (N, 2) of the camera; `bar` is a round length in the world's unit and
    `bar_px` its length in the picture.
    """

    title: str
    north_up: bool
    webp: bytes
    width_px: int
    height_px: int
    paths: list[Array]
    bar: float
    bar_px: float


def cloud_views(cloud: Cloud, segments: Sequence[Array]) -> list[CloudView]:
    """Plan view with north up, side view, and oblique view; none for an empty cloud.

    `segments` are unbroken parts (N, 3) of the camera's path in the world (north, east, down).
    """
    if len(cloud) == 0:
        return []
    heading = side_heading_rad(cloud, segments)
    side = f"From the side, looking {compass_point(heading)}"
    oblique_heading = oblique_heading_rad(cloud, segments)
    oblique = f"Oblique, looking {compass_point(oblique_heading)}"
    # two at a time, as numpy and OpenCV hold up no other thread; each holds a hundred megabytes
    with ThreadPoolExecutor(2, "views") as beside:
        views = [
            beside.submit(_view, cloud, segments, title, heading_rad, pitch_rad, aspects)
            for title, heading_rad, pitch_rad, aspects in (
                ("From above", 0.0, np.pi / 2, (1.3, 3.0)),
                (side, heading, 0.0, (1.6, 1.6)),
                (oblique, oblique_heading, OBLIQUE_DOWN_RAD, (1.6, 1.6)),
            )
        ]
        return [view.result() for view in views]


def side_heading_rad(cloud: Cloud, segments: Sequence[Array]) -> float:
    """Heading from which the cloud is widest, on the side of the camera's path."""
    flat = cloud.points[:, :2].astype(np.float64)
    middle = np.median(flat, axis=0)
    _, axes = np.linalg.eigh(np.cov((flat - middle).T) if len(flat) > 1 else np.eye(2))
    across = axes[:, 0]
    if segments:
        ahead = float(across @ (middle - np.median(np.concatenate(segments)[:, :2], axis=0)))
    else:
        ahead = float(across[0])
    if ahead < 0:
        across = -across
    return float(np.arctan2(across[1], across[0]))


def oblique_heading_rad(cloud: Cloud, segments: Sequence[Array]) -> float:
    """Heading of the oblique view: from beside the side view's."""
    return side_heading_rad(cloud, segments) + float(np.radians(30))


def compass_point(heading_rad: float) -> str:
    """Nearest of eight compass points.

    >>> compass_point(-1.6)
    'west'
    """
    return COMPASS[round(float(np.degrees(heading_rad)) / 45) % 8]


def view_axes(heading_rad: float, pitch_down_rad: float) -> Array:
    """Rows right, up and forward (3, 3) of a view, in the world (north, east, down)."""
    ch, sh = np.cos(heading_rad), np.sin(heading_rad)
    cp, sp = np.cos(pitch_down_rad), np.sin(pitch_down_rad)
    ahead = np.array([ch * cp, sh * cp, sp])
    right = np.array([-sh, ch, 0.0])
    return np.stack([right, np.cross(right, ahead), ahead])


def round_length(at_most: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is no longer than `at_most`.

    >>> round_length(37.0)
    20.0
    """
    power = 10.0 ** np.floor(np.log10(at_most))
    return float(max(step * power for step in (1, 2, 5) if step * power <= at_most * (1 + 1e-9)))


def splat(
    pixels: Array, ahead: Array, rgb: Bytes, height: int, width: int, size: int
) -> tuple[Bytes, Floats]:
    """Draw points (N, 2) as squares of `size`, the nearest on top.

    Returns the picture (H, W, 3), black where empty, and the depth of each pixel (H, W), float32,
    inf where empty.
    """
    order = np.argsort(-ahead, kind="stable")
    columns, rows = np.floor(pixels[order] + 0.5).astype(np.int64).T
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    # 0 is nothing, then the nearer the higher; float32 has each whole number up to 2**24
    rank = np.zeros((height, width), np.float32 if len(order) < 2**24 else np.float64)
    rank[rows[inside], columns[inside]] = np.flatnonzero(inside) + 1
    rank = np.asarray(cv2.dilate(rank, np.ones((size, size), np.uint8)))
    known = np.flatnonzero(rank)
    point = order[rank.ravel()[known].astype(np.int64) - 1]
    picture = np.zeros((height * width, 3), np.uint8)
    picture[known] = rgb[point]
    nearest = np.full(height * width, np.inf, np.float32)
    nearest[known] = ahead[point]
    return picture.reshape(height, width, 3), nearest.reshape(height, width)


def _view(
    cloud: Cloud,
    segments: Sequence[Array],
    title: str,
    heading_rad: float,
    pitch_rad: float,
    aspects: tuple[float, float],
) -> CloudView:
    axes = view_axes(heading_rad, pitch_rad)
    seen = cloud.points.astype(np.float64) @ axes.T
    flown = [segment @ axes.T for segment in segments]
    low, high = _frame(seen, flown, aspects)
    px_per_unit = WIDTH_PX / (high[0] - low[0])
    width, height = WIDTH_PX, round((high[1] - low[1]) * px_per_unit)

    def to_pixels(points: Array) -> Array:
        across = (points[:, 0] - low[0]) * px_per_unit
        return np.stack([across, (high[1] - points[:, 1]) * px_per_unit], 1)

    pixels = to_pixels(seen) * FINER - 0.5
    size = _splat_px(pixels)
    picture, nearest = splat(pixels, seen[:, 2], cloud.rgb, height * FINER, width * FINER, size)
    shaded = cv2.merge([_shade(nearest, 1 / (px_per_unit * FINER))] * 3) * picture
    bar = round_length(width / px_per_unit / 4)
    return CloudView(
        title, bool(pitch_rad > 1.5), _encode(shaded, np.isfinite(nearest), width, height),
        width, height, [to_pixels(segment) for segment in flown], bar, float(bar * px_per_unit),
    )  # fmt: skip


def _frame(
    seen: Array, flown: Sequence[Array], aspects: tuple[float, float]
) -> tuple[Array, Array]:
    """Corners (2,), low and high, around the path and all points but outliers.

    Width over height lies within `aspects`: a view too narrow or too low is padded.
    """
    low, high = np.percentile(seen[:, :2], [0.2, 99.8], axis=0)
    for line in flown:
        low = np.minimum(low, line[:, :2].min(0))
        high = np.maximum(high, line[:, :2].max(0))
    extent = high - low + 0.08 * max(float((high - low).max()), 1e-6)
    least, most = aspects
    width = max(extent[0], least * extent[1])
    half = np.array([width, max(extent[1], width / most)]) / 2
    middle = (low + high) / 2
    return middle - half, middle + half


def _splat_px(pixels: Array) -> int:
    """Side of squares that just close the gaps between points, by their density."""
    cells, _ = distinct_cells(np.floor(pixels / 16).astype(np.int64))
    per_cell = len(pixels) / len(cells)
    return int(np.clip(np.ceil(1.6 * 16 / np.sqrt(per_cell)), 1, MAX_SPLAT_PX))


def _shade(nearest: Floats, unit_per_px: float) -> Floats:
    """Darken pixels behind their neighbours, so that edges show without lighting."""
    reach = 3
    drop = np.zeros_like(nearest)
    known = np.isfinite(nearest)
    # next to nothing there is no drop, on either side
    far, near = np.where(known, nearest, -np.inf), np.where(known, nearest, np.inf)
    for here, beside in ((slice(reach, None), slice(-reach)), (slice(-reach), slice(reach, None))):
        for rows, others in ((np.s_[:, here], np.s_[:, beside]), (np.s_[here], np.s_[beside])):
            step = far[rows] - near[others]
            step *= 1 / (unit_per_px * 40)
            drop[rows] += np.clip(step, 0, 1, out=step)
    drop *= -0.35
    return np.exp(drop, out=drop)


def _encode(picture: Floats, known: NDArray[np.bool_], width: int, height: int) -> bytes:
    """Downscale to the final size with smooth edges, and encode; `picture` is black where empty."""
    size = width, height
    alpha = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    colour = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    colour = colour / np.maximum(alpha, 1e-6)[..., None]
    image = np.dstack([colour[..., ::-1], alpha * 255]).round().clip(0, 255).astype(np.uint8)
    _, data = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, 82])
    return data.tobytes()
