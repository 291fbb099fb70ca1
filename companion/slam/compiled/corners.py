"""Detection kernel: FAST corners (Rosten and Drummond, ECCV 2006), and Harris' response of each."""

from __future__ import annotations

import numpy as np

from companion.messages import Bytes, Floats
from companion.slam.compiled.compiling import (
    Ints,
    compiled,
    given,
    integer,
    part,
    single,
    tables,
    tiny_word,
)

BORDER = 31
"""Pixels of a level's rim without corners: a descriptor reaches so far."""
# positive for the compiler only where they are unsigned; then it reads runs of pixels at once
_1, _2, _3, _4, _5, _6 = (np.uintp(k) for k in range(1, 7))
_HARRIS, _SIDE = np.float32(0.04), 7
_SCALE = np.float32(1.0) / np.float32(4 * _SIDE * 255)


@part
def _contrast(
    up3: Bytes, up2: Bytes, up1: Bytes, row: Bytes, down1: Bytes, down2: Bytes, down3: Bytes,
    n: int, out: Bytes,
) -> None:  # fmt: skip
    """Least difference between a pixel and nine in a row on the circle about it, at its best.

    Of `n` pixels; the rows begin three pixels before the first.
    """
    for i in range(n):
        x = np.uintp(i)
        p0, p1, p2, p3 = down3[x + _3], down3[x + _4], down2[x + _5], down1[x + _6]
        p4, p5, p6, p7 = row[x + _6], up1[x + _6], up2[x + _5], up3[x + _4]
        p8, p9, p10, p11 = up3[x + _3], up3[x + _2], up2[x + _1], up1[x]
        p12, p13, p14, p15 = row[x], down1[x], down2[x + _1], down3[x + _2]
        # the least of two, four and eight neighbours; with either end that is the least of nine
        a, b, c, d = min(p1, p2), min(p3, p4), min(p5, p6), min(p7, p8)
        e, f, g, h = min(p9, p10), min(p11, p12), min(p13, p14), min(p15, p0)
        ab, bc, cd, de = min(a, b), min(b, c), min(c, d), min(d, e)
        ef, fg, gh, ha = min(e, f), min(f, g), min(g, h), min(h, a)
        brightest = max(
            max(
                max(min(min(ab, cd), max(p0, p9)), min(min(bc, de), max(p2, p11))),
                max(min(min(cd, ef), max(p4, p13)), min(min(de, fg), max(p6, p15))),
            ),
            max(
                max(min(min(ef, gh), max(p8, p1)), min(min(fg, ha), max(p10, p3))),
                max(min(min(gh, ab), max(p12, p5)), min(min(ha, bc), max(p14, p7))),
            ),
        )
        a, b, c, d = max(p1, p2), max(p3, p4), max(p5, p6), max(p7, p8)
        e, f, g, h = max(p9, p10), max(p11, p12), max(p13, p14), max(p15, p0)
        ab, bc, cd, de = max(a, b), max(b, c), max(c, d), max(d, e)
        ef, fg, gh, ha = max(e, f), max(f, g), max(g, h), max(h, a)
        darkest = min(
            min(
                min(max(max(ab, cd), min(p0, p9)), max(max(bc, de), min(p2, p11))),
                min(max(max(cd, ef), min(p4, p13)), max(max(de, fg), min(p6, p15))),
            ),
            min(
                min(max(max(ef, gh), min(p8, p1)), max(max(fg, ha), min(p10, p3))),
                min(max(max(gh, ab), min(p12, p5)), max(max(ha, bc), min(p14, p7))),
            ),
        )
        centre = row[x + _3]
        out[x] = max(np.uint8(max(brightest, centre) - centre),
                     np.uint8(centre - min(darkest, centre)))  # fmt: skip


@part
def _largest(
    above: Bytes, row: Bytes, below: Bytes, n: int, threshold: np.uint8, out: Bytes
) -> None:
    """Mark which of `n` are larger than a threshold and all about them; rows begin one before."""
    for x in range(n):
        around = max(
            max(max(above[x], above[x + 1]), max(above[x + 2], row[x])),
            max(max(row[x + 2], below[x]), max(below[x + 1], below[x + 2])),
        )
        out[x] = row[x + 1] > max(around, threshold)


@part
def _response(image: Bytes, width: int, at: int) -> np.float32:
    """Harris' response of the 7x7 pixels about one."""
    xx, yy, xy = 0, 0, 0
    for i in range(_SIDE):
        first = at + (i - 4) * width - 4
        up, row = image[first : first + 10], image[first + width : first + width + 10]
        down = image[first + 2 * width : first + 2 * width + 10]
        of_row_xx, of_row_yy, of_row_xy = np.int32(0), np.int32(0), np.int32(0)
        for k in range(_SIDE + 1):  # a power of two at once; the last does not count
            counts = np.int32(k < _SIDE)
            dx = 2 * (np.int32(row[k + 2]) - row[k]) + (np.int32(up[k + 2]) - up[k])
            dy = 2 * (np.int32(down[k + 1]) - up[k + 1]) + (np.int32(down[k]) - up[k])
            dx = np.int32(dx + np.int32(down[k + 2]) - down[k]) * counts
            dy = np.int32(dy + np.int32(down[k + 2]) - up[k + 2]) * counts
            of_row_xx = np.int32(of_row_xx + dx * dx)
            of_row_yy = np.int32(of_row_yy + dy * dy)
            of_row_xy = np.int32(of_row_xy + dx * dy)
        xx, yy, xy = xx + int(of_row_xx), yy + int(of_row_yy), xy + int(of_row_xy)
    a, b, c = np.float32(xx), np.float32(yy), np.float32(xy)
    return (a * b - c * c - _HARRIS * (a + b) * (a + b)) * (_SCALE * _SCALE * _SCALE * _SCALE)


@part
def _keep_strongest(strength: Floats, at: Ints, n_most: int) -> int:
    """Leave the strongest of some corners, in their order, and as many more as equal the last."""
    n = len(at)
    if n <= n_most:
        return n
    least, n = np.sort(strength)[n - n_most], 0
    for i in range(len(at)):
        if strength[i] >= least:
            at[n], strength[n] = at[i], strength[i]
            n += 1
    return n


@compiled(given(tiny_word, 1), tables, given(single, 1), integer)
def corners(
    pyramid: Bytes, levels: Ints, scales: Floats, threshold: int
) -> tuple[Ints, Ints, Floats, Floats]:
    """Corners of a pyramid: their place in it (N,), level (N,), pixels (N, 2), response (N,).

    The levels of the `pyramid` stand one after the other: `levels` (L, 4) are the first pixel of
    each, its width, its height and how many corners are wanted at most: twice as many by contrast,
    so many of these by response. `scales` (L,) are pixels of the image by its own.
    """
    at, n = np.empty(len(pyramid) // 4, np.int64), 0  # none beside another
    strength, level = np.empty(len(at), np.float32), np.empty(len(at), np.int64)
    contrast = np.empty(levels[0, 1] * levels[0, 2], np.uint8)
    eights = np.empty(len(contrast) // 8 + 1, np.uint64)
    is_corner = eights.view(np.uint8)
    for i in range(len(levels)):
        start, width, height, n_most = levels[i]
        # all rows as one, with their ends, from a row before the first that has corners
        n_all = (height - 2 * BORDER + 2) * width
        if n_all <= 0:
            continue
        first, n_inner, n_before = start + (BORDER - 1) * width - 3, n_all - 2 * width - 2, n
        _contrast(
            pyramid[first - 3 * width :], pyramid[first - 2 * width :], pyramid[first - width :],
            pyramid[first:], pyramid[first + width :], pyramid[first + 2 * width :],
            pyramid[first + 3 * width :], n_all, contrast,
        )  # fmt: skip
        _largest(
            contrast, contrast[width:], contrast[2 * width :], n_inner, np.uint8(threshold),
            is_corner,
        )  # fmt: skip
        for k in range(n_inner // 8 + 1):
            if eights[k] != 0:
                for x in range(8 * k, min(8 * k + 8, n_inner)):
                    inside = BORDER <= (x + 1) % width < width - BORDER
                    if inside and is_corner[x] != 0:
                        at[n], strength[n] = start + BORDER * width + 1 + x, contrast[width + 1 + x]
                        n += 1
        n = n_before + _keep_strongest(strength[n_before:n], at[n_before:n], 2 * n_most)
        for k in range(n_before, n):
            strength[k] = _response(pyramid, width, at[k])
        n = n_before + _keep_strongest(strength[n_before:n], at[n_before:n], n_most)
        level[n_before:n] = i
    pixels = np.empty((n, 2), np.float32)
    for k in range(n):
        start, width = levels[level[k], 0], levels[level[k], 1]
        pixels[k, 0] = np.float32((at[k] - start) % width) * scales[level[k]]
        pixels[k, 1] = np.float32((at[k] - start) // width) * scales[level[k]]
    return at[:n].copy(), level[:n].copy(), pixels, strength[:n].copy()
