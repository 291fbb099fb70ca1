"""Sub-pixel localisation of map points by alignment of their reference patch.

A corner detected independently in each image is off by half a pixel; inverse compositional
alignment (Baker & Matthews, IJCV 2004) of the patch of the reference view is several times better.
The patch is warped as a small plane that faces the reference view.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from companion.geometry.transforms import Array
from companion.messages import Bytes
from companion.slam.compiled import patch_alignment
from companion.slam.compiled.patch_alignment import N_LEVELS, STORED
from companion.slam.features.orb_features import Bools, Ints


def image_levels(grey: Bytes) -> list[Bytes]:
    """Pyramid of an image (H, W) at full, half and quarter size; pixel p maps to p / 2."""
    levels = [np.ascontiguousarray(grey)]
    for _ in range(N_LEVELS - 1):
        levels.append(np.asarray(cv2.pyrDown(levels[-1]), np.uint8))
    return levels


def level_of(octaves: Ints, scale_factor: float) -> Ints:
    """Pyramid level at which corners of these octaves are compared."""
    level = np.rint(octaves * np.log2(scale_factor) - 0.5)
    return np.asarray(np.clip(level, 0, N_LEVELS - 1), np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class Patches:
    """Stored patches: `grey` (N, 24, 24) u8, `centre` (N, 2) within it, `level` (N,), -1: none."""

    grey: Bytes
    centre: Array
    level: Ints


def cut(levels: list[Bytes], pixels: Array, level: Ints) -> Patches:
    """Extract the patches around full-resolution `pixels` (N, 2)."""
    scaled = pixels / 2.0 ** level[:, None]
    corner = np.floor(scaled).astype(np.int64) - STORED // 2 + 1
    grey = np.zeros((len(pixels), STORED, STORED), np.uint8)
    at = level.copy()
    steps = np.arange(STORED)
    for k, image in enumerate(levels):
        h, w = image.shape
        inside = (corner >= 0).all(1) & (corner[:, 0] + STORED <= w) & (corner[:, 1] + STORED <= h)
        at[(level == k) & ~inside] = -1
        here = np.flatnonzero((level == k) & inside)
        rows, columns = corner[here, 1, None] + steps, corner[here, 0, None] + steps
        grey[here] = image[rows[:, :, None], columns[:, None, :]]
    return Patches(grey, scaled - corner, at)


def align(
    patches: Patches,
    image_from_patch: Array,
    levels: list[Bytes],
    pixels: Array,
    max_move_px: Array,
) -> tuple[Array, Bools]:
    """Align patches near full-resolution `pixels` (N, 2); aligned pixels and a mask of success.

    `image_from_patch` (N, 2, 2) is the warp between full-resolution pixels; a patch may move by at
    most `max_move_px` (N,).
    """
    full, half, quarter = levels
    return patch_alignment.align(
        patches.grey, patches.centre, patches.level, image_from_patch, full, half, quarter, pixels,
        max_move_px,
    )  # fmt: skip
