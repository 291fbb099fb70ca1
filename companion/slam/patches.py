"""Where a map point lies in an image to a fraction of a pixel: its first patch, laid over it.

A corner found in each image by itself is off by half a pixel; aligning the patch of the view that
defines a point (inverse compositional: Baker & Matthews, IJCV 2004) is several times better. The
patch is warped as a small plane that faces the first view would be.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from companion.geometry import Array
from companion.messages import Bytes, Floats
from companion.slam.features import Bools, Ints

N_LEVELS = 3
STORED = 24
"""Side of a stored patch: room for the compared part to be turned and scaled."""
HALF = 4
ITERATIONS = 8
CONVERGED_PX = 0.02
MIN_ZNCC = 0.85
MIN_TEXTURE = 25.0
"""Least eigenvalue of the mean outer product of gradients, (grey levels per pixel) squared."""
MIN_SCALE, MAX_SCALE = 0.6, 1.6

_SIDE = 2 * HALF + 1
_STEPS = np.arange(-HALF - 1, HALF + 2, dtype=np.float32)
_GRID = np.stack(np.meshgrid(_STEPS, _STEPS), -1).reshape(-1, 2)
_INNER = np.arange((_SIDE + 2) ** 2).reshape(_SIDE + 2, _SIDE + 2)[1:-1, 1:-1].ravel()
_RIGHT, _LEFT, _BELOW, _ABOVE = _INNER + 1, _INNER - 1, _INNER + _SIDE + 2, _INNER - _SIDE - 2


def image_levels(grey: Bytes) -> list[Floats]:
    """An image (H, W) at full, half and quarter size; pixel p of one is pixel p / 2 of the next."""
    levels = [grey]
    for _ in range(N_LEVELS - 1):
        levels.append(np.asarray(cv2.pyrDown(levels[-1]), np.uint8))
    return [level.astype(np.float32) for level in levels]


def level_of(octaves: Ints, scale_factor: float) -> Ints:
    """The level at which corners of these octaves are compared."""
    level = np.rint(octaves * np.log2(scale_factor) - 0.5)
    return np.asarray(np.clip(level, 0, N_LEVELS - 1), np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class Patches:
    """Stored patches: `grey` (N, 24, 24) u8, `centre` (N, 2) within it, `level` (N,), -1: none."""

    grey: Bytes
    centre: Array
    level: Ints


def cut(levels: list[Floats], pixels: Array, level: Ints) -> Patches:
    """The patches around full-size `pixels` (N, 2)."""
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
    levels: list[Floats],
    pixels: Array,
    max_move_px: Array,
) -> tuple[Array, Bools]:
    """Where patches lie near full-size `pixels` (N, 2) of an image, and which were found for sure.

    `image_from_patch` (N, 2, 2) is the warp between full-size pixels; a patch may move by
    `max_move_px` (N,) at most.
    """
    found = pixels.astype(np.float64)
    sure = np.zeros(len(pixels), bool)
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = np.sqrt(np.abs(np.linalg.det(image_from_patch)))
        level = patches.level + np.rint(np.log2(np.where(scale > 0, scale, 1.0))).astype(np.int64)
    usable = (patches.level >= 0) & np.isfinite(scale)
    level = np.clip(level, 0, N_LEVELS - 1)
    warp = image_from_patch * (2.0 ** (patches.level - level))[:, None, None]
    relative = scale * 2.0 ** (patches.level - level)
    usable &= (relative > MIN_SCALE) & (relative < MAX_SCALE)
    for k, image in enumerate(levels):
        here = np.flatnonzero(usable & (level == k))
        if len(here):
            start = found[here] / 2.0**k
            moved, good = _align(
                patches.grey[here], patches.centre[here], np.linalg.inv(warp[here]), image, start
            )
            far = np.linalg.norm(moved - start, axis=1) * 2.0**k
            good &= far < max_move_px[here]
            found[here[good]] = moved[good] * 2.0**k
            sure[here] = good
    return found, sure


def _align(
    grey: Bytes, centre: Array, patch_from_image: Array, image: Floats, start: Array
) -> tuple[Array, Bools]:
    n = len(grey)
    back = patch_from_image.astype(np.float32)
    at: Floats = np.matmul(_GRID[None], back.transpose(0, 2, 1))
    at += centre[:, None].astype(np.float32)
    corners = at[:, [0, _SIDE + 1, -_SIDE - 2, -1]]
    good = (corners.min((1, 2)) >= 0) & (corners.max((1, 2)) <= STORED - 1)
    at[:, :, 1] += STORED * np.arange(n, dtype=np.float32)[:, None]
    template = _sample(grey.reshape(n * STORED, STORED).astype(np.float32), at)
    gx = 0.5 * (template[:, _RIGHT] - template[:, _LEFT])
    gy = 0.5 * (template[:, _BELOW] - template[:, _ABOVE])
    inner = template[:, _INNER]
    inner = inner - inner.mean(1, keepdims=True)
    spread = np.sqrt((inner * inner).mean(1))
    gx, gy = gx - gx.mean(1, keepdims=True), gy - gy.mean(1, keepdims=True)
    a, b, c = (gx * gx).mean(1), (gx * gy).mean(1), (gy * gy).mean(1)
    det = a * c - b * b
    least = 0.5 * (a + c) - np.sqrt(0.25 * (a - c) ** 2 + b * b)
    good &= (least > MIN_TEXTURE) & (spread > 2.0)
    det = np.where(det > 1e-6, det, 1.0)
    h, w = image.shape
    grid = _GRID[_INNER]
    place = start.astype(np.float32)
    zncc, last = np.zeros(n, np.float32), np.full(n, np.inf, np.float32)
    going = np.flatnonzero(good)
    for _ in range(ITERATIONS):
        if not len(going):
            break
        seen = _sample(image, place[going, None] + grid[None])
        seen -= seen.mean(1, keepdims=True)
        contrast = np.maximum(np.sqrt(np.einsum("ij,ij->i", seen, seen) / _SIDE**2), 1e-3)
        gain = (spread[going] / contrast)[:, None]
        error = seen * gain - inner[going]
        ex = np.einsum("ij,ij->i", gx[going], error) / _SIDE**2
        ey = np.einsum("ij,ij->i", gy[going], error) / _SIDE**2
        zncc[going] = (
            np.einsum("ij,ij->i", seen, inner[going])
            / _SIDE**2
            / (contrast * np.maximum(spread[going], 1e-3))
        )
        step = (
            np.stack([c[going] * ex - b[going] * ey, a[going] * ey - b[going] * ex], 1)
            / det[going, None]
        )
        np.clip(step, -1.0, 1.0, out=step)
        place[going] -= step
        last[going] = np.abs(step).max(1)
        going = going[last[going] > CONVERGED_PX]
    good &= (zncc > MIN_ZNCC) & (last < 0.1)
    good &= (
        np.asarray(place.min(1) >= HALF)
        & (place[:, 0] < w - HALF - 1)
        & (place[:, 1] < h - HALF - 1)
    )
    return place.astype(np.float64), good


def _sample(image: Floats, at: Floats) -> Floats:
    """Bilinear samples of an image (H, W) at pixels (N, M, 2); beyond it as at its edge."""
    sampled = cv2.remap(
        image, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(sampled, np.float32)
