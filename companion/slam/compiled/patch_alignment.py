"""Inverse compositional alignment of stored patches with an image."""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Array
from companion.messages import Bytes
from companion.slam.compiled.compiling import (
    Bools,
    Ints,
    compiled,
    images,
    integers,
    matrices,
    numbers,
    pairs,
    part,
    patches,
)

N_LEVELS = 3
STORED = 24
"""Side of a stored patch, px: room to rotate and scale the compared part."""
HALF = 4
ITERATIONS = 8
CONVERGED_PX = 0.02
MIN_ZNCC = 0.85
MIN_TEXTURE = 25.0
"""Smallest eigenvalue of the structure tensor per pixel, (grey levels per pixel) squared."""
MIN_SPREAD = 2.0
"""Smallest standard deviation of a patch, grey levels."""
MIN_SCALE, MAX_SCALE = 0.6, 1.6
_SIDE = 2 * HALF + 1
_AREA = float(_SIDE * _SIDE)
_ONES = np.ones(_SIDE * _SIDE)
_1, _2, _3 = (np.uintp(k) for k in range(1, 4))


@part
def _template(stored: Bytes, centre: Array, patch_from_image: Array, out: Array) -> bool:
    """Warped patch, one pixel wider than compared; False where it exceeds the stored patch."""
    for i in range(_SIDE + 2):
        for j in range(_SIDE + 2):
            dx, dy = float(j - HALF - 1), float(i - HALF - 1)
            x = patch_from_image[0, 0] * dx + patch_from_image[0, 1] * dy + centre[0]
            y = patch_from_image[1, 0] * dx + patch_from_image[1, 1] * dy + centre[1]
            if not (0.0 <= x <= STORED - 1.0 and 0.0 <= y <= STORED - 1.0):
                return False
            column, row = min(int(x), STORED - 2), min(int(y), STORED - 2)
            x, y = x - column, y - row
            above = (1.0 - x) * stored[row, column] + x * stored[row, column + 1]
            below = (1.0 - x) * stored[row + 1, column] + x * stored[row + 1, column + 1]
            out[i, j] = (1.0 - y) * above + y * below
    return True


@part
def _dot(a: Array, b: Array) -> float:
    """Sum of products, in four sums that do not wait for each other."""
    s0 = s1 = s2 = s3 = 0.0
    for k in range(0, len(a) - 3, 4):
        i = np.uintp(k)
        s0 += a[i] * b[i]
        s1 += a[i + _1] * b[i + _1]
        s2 += a[i + _2] * b[i + _2]
        s3 += a[i + _3] * b[i + _3]
    for k in range(len(a) // 4 * 4, len(a)):
        s0 += a[k] * b[k]
    return (s0 + s1) + (s2 + s3)


@part
def _without_mean(values: Array) -> None:
    values -= _dot(values, _ONES) / _AREA


@part
def _sample(image: Bytes, x: float, y: float, out: Array) -> bool:
    """Bilinear samples around a pixel; False where not all inside."""
    h, w = image.shape
    if not (HALF <= x < w - HALF - 1 and HALF <= y < h - HALF - 1):
        return False
    column, row = int(x), int(y)
    x, y = x - column, y - row
    a, b, c, d = (1.0 - x) * (1.0 - y), x * (1.0 - y), (1.0 - x) * y, x * y
    for i in range(_SIDE):
        top, left = row + i - HALF, column - HALF
        for j in range(_SIDE):
            out[i * _SIDE + j] = (
                a * image[top, left + j]
                + b * image[top, left + j + 1]
                + c * image[top + 1, left + j]
                + d * image[top + 1, left + j + 1]
            )
    return True


@part
def _fit(
    stored: Bytes,
    centre: Array,
    patch_from_image: Array,
    image: Bytes,
    position: Array,
    work: Array,
) -> bool:
    """Move a position (2,) to the best alignment of a patch with an image; False on failure."""
    wide = np.empty((_SIDE + 2, _SIDE + 2))
    if not _template(stored, centre, patch_from_image, wide):
        return False
    inner, gx, gy, seen, error = work[0], work[1], work[2], work[3], work[4]
    for i in range(_SIDE):
        for j in range(_SIDE):
            k = i * _SIDE + j
            inner[k] = wide[i + 1, j + 1]
            gx[k] = 0.5 * (wide[i + 1, j + 2] - wide[i + 1, j])
            gy[k] = 0.5 * (wide[i + 2, j + 1] - wide[i, j + 1])
    _without_mean(inner)
    _without_mean(gx)
    _without_mean(gy)
    spread = np.sqrt(_dot(inner, inner) / _AREA)
    a, b, c = _dot(gx, gx) / _AREA, _dot(gx, gy) / _AREA, _dot(gy, gy) / _AREA
    least = 0.5 * (a + c) - np.sqrt(0.25 * (a - c) * (a - c) + b * b)
    if not (least > MIN_TEXTURE and spread > MIN_SPREAD):
        return False
    det = a * c - b * b
    zncc, last = 0.0, np.inf
    for _ in range(ITERATIONS):
        if not _sample(image, position[0], position[1], seen):
            return False
        _without_mean(seen)
        contrast = max(np.sqrt(_dot(seen, seen) / _AREA), 1e-3)
        gain = spread / contrast
        for i in range(len(error)):
            at = np.uintp(i)
            error[at] = seen[at] * gain - inner[at]
        ex, ey = _dot(gx, error) / _AREA, _dot(gy, error) / _AREA
        zncc = _dot(seen, inner) / _AREA / (contrast * spread)
        step_x = min(max((c * ex - b * ey) / det, -1.0), 1.0)
        step_y = min(max((a * ey - b * ex) / det, -1.0), 1.0)
        position[0] -= step_x
        position[1] -= step_y
        last = max(abs(step_x), abs(step_y))
        if last <= CONVERGED_PX:
            break
    h, w = image.shape
    inside = HALF <= position[0] < w - HALF - 1 and HALF <= position[1] < h - HALF - 1
    return inside and zncc > MIN_ZNCC and last < 0.1


@compiled(patches, pairs, integers, matrices, images, images, images, pairs, numbers)
def align(
    grey: Bytes, centre: Array, stored_level: Ints, image_from_patch: Array, image: Bytes,
    half_image: Bytes, quarter_image: Bytes, pixels: Array, max_move_px: Array,
) -> tuple[Array, Bools]:  # fmt: skip
    """Alignment of patches, see `companion.slam.features.patches.align`."""
    found, sure = pixels.copy(), np.zeros(len(pixels), np.bool_)
    back, position, work = np.empty((2, 2)), np.empty(2), np.empty((5, _SIDE * _SIDE))
    for i in range(len(pixels)):
        warp = image_from_patch[i]
        det = warp[0, 0] * warp[1, 1] - warp[0, 1] * warp[1, 0]
        scale = np.sqrt(abs(det))
        if stored_level[i] < 0 or not 0.0 < scale < np.inf:
            continue
        level = stored_level[i] + int(np.rint(np.log2(scale)))
        level = min(max(level, 0), N_LEVELS - 1)
        shrunk = 2.0 ** (stored_level[i] - level)
        if not MIN_SCALE < scale * shrunk < MAX_SCALE:
            continue
        back[0, 0], back[0, 1] = warp[1, 1] / det / shrunk, -warp[0, 1] / det / shrunk
        back[1, 0], back[1, 1] = -warp[1, 0] / det / shrunk, warp[0, 0] / det / shrunk
        size = 2.0**level
        position[0], position[1] = pixels[i, 0] / size, pixels[i, 1] / size
        here = image if level == 0 else half_image if level == 1 else quarter_image
        if not _fit(grey[i], centre[i], back, here, position, work):
            continue
        x, y = position[0] * size, position[1] * size
        if np.hypot(x - pixels[i, 0], y - pixels[i, 1]) < max_move_px[i]:
            found[i, 0], found[i, 1], sure[i] = x, y, True
    return found, sure
