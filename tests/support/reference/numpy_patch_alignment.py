"""Reference implementation of patch alignment in numpy."""

from __future__ import annotations

import cv2
import numpy as np

from companion.geometry.transforms import Array
from companion.messages import Bytes, Floats
from companion.slam.compiled.patch_alignment import (
    CONVERGED_PX,
    HALF,
    ITERATIONS,
    MAX_SCALE,
    MIN_SCALE,
    MIN_TEXTURE,
    MIN_ZNCC,
    N_LEVELS,
    STORED,
)
from companion.slam.features.orb_features import Bools
from companion.slam.features.patches import Patches

_SIDE = 2 * HALF + 1
_STEPS = np.arange(-HALF - 1, HALF + 2, dtype=np.float32)
_GRID = np.stack(np.meshgrid(_STEPS, _STEPS), -1).reshape(-1, 2)
_INNER = np.arange((_SIDE + 2) ** 2).reshape(_SIDE + 2, _SIDE + 2)[1:-1, 1:-1].ravel()
_RIGHT, _LEFT, _BELOW, _ABOVE = _INNER + 1, _INNER - 1, _INNER + _SIDE + 2, _INNER - _SIDE - 2


def align(
    patches: Patches,
    image_from_patch: Array,
    levels: list[Bytes],
    pixels: Array,
    max_move_px: Array,
) -> tuple[Array, Bools]:
    """As `companion.slam.features.patches.align`."""
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
                patches.grey[here],
                patches.centre[here],
                np.linalg.inv(warp[here]),
                image.astype(np.float32),
                start,
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
