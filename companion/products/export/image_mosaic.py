"""Orthomosaic of the flight's pictures, put on the surface of the cloud and blended."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.errors import InputError
from companion.geometry.camera import Camera
from companion.messages import Bytes, Floats
from companion.products.export.flight_pictures import FlightPictures, PlacedPicture
from companion.products.export.map_frame import MapFrame
from companion.products.export.picture_sight import depth_buffer, is_uncovered, projected, within
from companion.products.export.surface import Surface

STEP = 0.08
"""Pictures apart by this share of the distance."""
MAX_CELLS = 30_000_000
"""28 bytes each while it is made: 0.8 GB."""
SHARPNESS = 6
"""Power of a picture's merit: the best dominates, and seams still fade into each other."""
LEAST_COSINE = 0.25
"""Steeper views of the ground, 75 degrees from above, are not used."""


@dataclass(frozen=True, slots=True, eq=False)
class Mosaic:
    """Colours (H, W, 3) with north up, and True (H, W) where a picture showed the place.

    `west`, `north` is the outer corner of the first cell, in the map's metres.
    """

    rgb: Bytes
    seen: NDArray[np.bool_]
    west: float
    north: float
    cell_m: float
    n_pictures: int


def image_mosaic(
    pictures: FlightPictures, surface: Surface, frame: MapFrame, cell_m: float = 0.0
) -> Mosaic:
    """Mosaic of cells of `cell_m`; 0 takes what a pixel covers on the ground.

    Each place has the mean of the pictures that show it, by their merit: from above, from near,
    away from the picture's border. InputError where cells would be too many.
    """
    coarse = _surface_ned(surface, frame)
    usual_m = _usual_depth_m(pictures, coarse)
    cell = cell_m or float(f"{usual_m / pictures.camera.focal_px:.2g}")
    finer = surface.cell_m / cell
    height, width = (round(n * finer) for n in surface.height.shape)
    if height * width > MAX_CELLS:
        if cell_m:
            raise InputError(
                f"a mosaic of {width} x {height} cells of {cell:g} m is too large: set "
                "expert.export.cell_m larger"
            )
        cell *= float(np.sqrt(height * width / MAX_CELLS))
        finer = surface.cell_m / cell
        height, width = (int(n * finer) for n in surface.height.shape)
    sums = np.zeros((height, width, 3), np.float32)
    weights = np.zeros((height, width), np.float32)
    camera, n = pictures.camera, 0
    for picture in pictures.spaced(STEP):
        n += _add(picture, camera, coarse, finer, usual_m, sums, weights)
    seen = weights > 0
    rgb = np.rint(sums / np.where(seen, weights, 1)[..., None]).astype(np.uint8)
    return Mosaic(rgb, seen, surface.west, surface.north, surface.cell_m / finer, n)


def _surface_ned(surface: Surface, frame: MapFrame) -> Floats:
    """Local NED (H, W, 3) of the cells' middles; nan where there is no surface."""
    rows, columns = np.nonzero(np.isfinite(surface.height))
    wanted = np.column_stack([
        surface.west + (columns + 0.5) * surface.cell_m,
        surface.north - (rows + 0.5) * surface.cell_m,
        surface.height[rows, columns],
    ])  # fmt: skip
    zero = frame.coordinates(np.zeros((1, 3)))[0]
    slopes = frame.coordinates(10.0 * np.eye(3)) - zero
    ned_from_map = np.linalg.inv(slopes / 10.0)
    ned = (wanted - zero) @ ned_from_map
    for _ in range(2):  # the Earth is round: millimetres at a kilometre after one step
        ned += (wanted - frame.coordinates(ned)) @ ned_from_map
    out = np.full((*surface.height.shape, 3), np.nan, np.float32)
    out[rows, columns] = ned
    return out


def _usual_depth_m(pictures: FlightPictures, coarse: Floats) -> float:
    """Median depth of the surface in the pictures, metres."""
    places = coarse[np.isfinite(coarse[..., 0])].astype(np.float64)
    some = places[:: max(1, len(places) // 5000)]
    depths = []
    for pose in pictures.run.poses[:: max(1, len(pictures.run.poses) // 50)]:
        seen = pose.world_from_camera.inverse().apply(some)
        pixels = pictures.camera.project(seen)
        inside = ((pixels >= 0) & (pixels < [pictures.camera.width, pictures.camera.height])).all(1)
        depths.append(seen[inside, 2])
    together = np.concatenate(depths)
    if not len(together):
        raise InputError("no picture shows the surface of the cloud")
    return float(np.median(together))


def _add(
    picture: PlacedPicture, camera: Camera, coarse: Floats, finer: float, scale_m: float,
    sums: Floats, weights: Floats,
) -> int:  # fmt: skip
    """Add a picture where it shows the surface; 0 where it shows none of it.

    `scale_m` is a usual depth, in which merits are near 1.
    """
    pose = picture.pose.world_from_camera
    known = np.isfinite(coarse[..., 0])
    pixels, depth = projected(coarse[known].astype(np.float64), pose, camera)
    inside = np.zeros(known.shape, bool)
    inside[known] = within(pixels, camera) & (depth > 0)
    if not inside.any():
        return 0
    nearest = depth_buffer(pixels, depth, camera)
    rows, columns = (np.flatnonzero(inside.any(axis)) for axis in (1, 0))
    top, bottom = max(rows[0] - 1, 0), min(rows[-1] + 2, known.shape[0])
    left, right = max(columns[0] - 1, 0), min(columns[-1] + 2, known.shape[1])
    fine_rows = np.arange(int(top * finer), min(int(bottom * finer), sums.shape[0]))
    fine_columns = np.arange(int(left * finer), min(int(right * finer), sums.shape[1]))
    ned, there = _finer(coarse, fine_rows, fine_columns, finer)
    pixels, depth = projected(ned.astype(np.float64), pose, camera)
    rays = ned - pose.translation.astype(np.float32)
    cosine = rays[..., 2] / np.maximum(np.linalg.norm(rays, axis=-1), 1e-6)
    good = there & within(pixels, camera) & (depth > 0) & (cosine > LEAST_COSINE)
    at = np.where(good[..., None], pixels, 0)
    good = good & is_uncovered(at, depth, nearest)
    middle = np.array([camera.width - 1, camera.height - 1]) / 2
    inwards = 1.02 - np.abs((at - middle) / (middle + 1)).max(-1)
    merit = cosine * np.minimum(inwards, 0.5) / np.maximum(depth, 1e-3)
    weight = np.where(good, (merit * scale_m) ** SHARPNESS, 0)
    sampled = cv2.remap(
        picture.rgb, at[..., 0].astype(np.float32), at[..., 1].astype(np.float32), cv2.INTER_LINEAR
    )
    into = np.s_[fine_rows[0] : fine_rows[-1] + 1, fine_columns[0] : fine_columns[-1] + 1]
    weights[into] += weight.astype(np.float32)
    sums[into] += weight[..., None].astype(np.float32) * sampled
    return 1


def _finer(
    ned: Floats, rows: NDArray[np.int64], columns: NDArray[np.int64], finer: float
) -> tuple[Floats, NDArray[np.bool_]]:
    """Places (H, W, 3) of cells of the finer grid, and True where the surface is known."""
    # the middle of a fine cell, counted in coarse cells from the middle of the first
    at = np.meshgrid((columns + 0.5) / finer - 0.5, (rows + 0.5) / finer - 0.5)
    u, v = (each.astype(np.float32) for each in at)
    known = np.isfinite(ned[..., 0])
    # the mean of the known neighbours, weighted as by bilinear interpolation
    how = cv2.INTER_LINEAR, cv2.BORDER_REPLICATE
    share = np.asarray(cv2.remap(known.astype(np.float32), u, v, how[0], borderMode=how[1]))
    filled = cv2.remap(np.where(known[..., None], ned, 0), u, v, how[0], borderMode=how[1])
    out = np.asarray(filled) / np.maximum(share, 1e-6)[..., None]
    return np.asarray(out, np.float32), np.asarray(share > 0.5)
