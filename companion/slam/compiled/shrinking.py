"""Pyramid kernel: each level shrunk from the one before, to the bit as OpenCV's LINEAR_EXACT."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from companion.messages import Bytes
from companion.slam.compiled.compiling import Ints, compiled, part, tables, tiny_words_out

_1, _8, _16, _32, _48 = (np.uint64(k) for k in (1, 8, 16, 32, 48))
_HALVES = np.uint64(0x0000800000008000)
"""Half of what is shifted out, of both rows."""


@part
def _places(n_from: int, n_to: int, first: NDArray[np.uint64], share: NDArray[np.uint64]) -> None:
    """First of the two pixels that each of `n_to` lies between, and 256ths of the second."""
    scale = 1.0 / (n_to / n_from)
    for i in range(n_to):
        at = min(max(scale * (i + 0.5) - 0.5, 0.0), n_from - 1.0)
        before = min(np.floor(at), n_from - 2.0)
        first[i], share[i] = np.uint64(before), np.uint64(np.rint((at - before) * 256.0))


@part
def _down(
    up0: Bytes, down0: Bytes, share0: int, up1: Bytes, down1: Bytes, share1: int, n: int,
    out: NDArray[np.uint64],
) -> None:  # fmt: skip
    """Two rows between two each: the first in the low half of a number, the second in the high.

    `share0` and `share1` are 256ths of the lower one. Floats are exact here, their products fast.
    """
    of_up0, of_down0 = np.float32(256 - share0), np.float32(share0)
    of_up1, of_down1 = np.float32(256 - share1), np.float32(share1)
    for i in range(n):
        x = np.uintp(i)
        low = of_up0 * np.float32(up0[x]) + of_down0 * np.float32(down0[x])
        high = of_up1 * np.float32(up1[x]) + of_down1 * np.float32(down1[x])
        out[x] = np.uint64(np.uint32(np.int32(low))) | (np.uint64(np.uint32(np.int32(high))) << _32)


@part
def _along(
    rows: NDArray[np.uint64], first: NDArray[np.uint64], share: NDArray[np.uint64], n: int,
    out0: Bytes, out1: Bytes,
) -> None:  # fmt: skip
    """Both rows between pixels: one product for the two, as neither half exceeds 24 bits."""
    for i in range(n):
        x = np.uintp(i)
        left = rows[first[x]]
        both = (left << _8) + share[x] * (rows[first[x] + _1] - left) + _HALVES
        out0[x], out1[x] = np.uint8(both >> _16), np.uint8(both >> _48)


@compiled(tiny_words_out, tables)
def shrink(pyramid: Bytes, levels: Ints) -> None:
    """Fill a pyramid from its first level; `levels` (L, 4) as of `corners`.

    Levels of one row or column, too small for any corner, are black.
    """
    most = np.max(levels[:, 1:3])
    first, share = np.empty(most, np.uint64), np.empty(most, np.uint64)
    above, below = np.empty(most, np.uint64), np.empty(most, np.uint64)
    rows = np.empty(most, np.uint64)
    for k in range(1, len(levels)):
        from_start, from_width, from_height = levels[k - 1, 0], levels[k - 1, 1], levels[k - 1, 2]
        start, width, height = levels[k, 0], levels[k, 1], levels[k, 2]
        if min(width, height, from_width, from_height) < 2:
            pyramid[start : start + width * height] = 0
            continue
        _places(from_width, width, first, share)
        _places(from_height, height, above, below)
        for y in range(0, height, 2):
            at = min(y, height - 2)  # of an odd number the last but one again
            up0 = from_start + int(above[at]) * from_width
            up1 = from_start + int(above[at + 1]) * from_width
            _down(
                pyramid[up0:], pyramid[up0 + from_width :], int(below[at]),
                pyramid[up1:], pyramid[up1 + from_width :], int(below[at + 1]),
                from_width, rows,
            )  # fmt: skip
            to = start + at * width
            _along(rows, first, share, width, pyramid[to:], pyramid[to + width :])
