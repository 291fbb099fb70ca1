"""Descriptor search kernels: around projections, and along epipolar lines."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from companion.geometry.transforms import Array
from companion.messages import Floats
from companion.slam.compiled.compiling import (
    Ints,
    compiled,
    integer,
    integers,
    number,
    numbers,
    pairs,
    part,
    single_pairs,
    words,
)

Words = NDArray[np.uint64]

CELL_PX = 32.0
RUN = 32
"""Features whose distances to an epipolar line are looked at together: most runs have none near."""
N_NEAREST = 12
"""Features examined around a pixel."""
_FAR = np.float32(1000.0)
_PAIRS, _FOURS = np.uint64(0x5555555555555555), np.uint64(0x3333333333333333)
_EIGHTS, _SUM = np.uint64(0x0F0F0F0F0F0F0F0F), np.uint64(0x0101010101010101)
_1, _2, _4, _56 = np.uint64(1), np.uint64(2), np.uint64(4), np.uint64(56)


@part
def _differing_bits(a: Words, b: Words) -> int:
    total = 0
    for k in range(4):
        x = a[k] ^ b[k]
        x = x - ((x >> _1) & _PAIRS)
        x = (x & _FOURS) + ((x >> _2) & _FOURS)
        x = (x + (x >> _4)) & _EIGHTS
        total += int((x * _SUM) >> _56)
    return total


@part
def _cell(position: float, n_cells: int) -> int:
    return int(min(max(position / CELL_PX, 0.0), n_cells - 1.0))


@part
def _in_cells(pixels: Floats, n_columns: int, n_rows: int) -> tuple[Ints, Ints]:
    """Features ordered by grid cell, and the start of each cell, and the end."""
    starts = np.zeros(n_columns * n_rows + 1, np.int64)
    cells = np.empty(len(pixels), np.int64)
    for i in range(len(pixels)):
        cells[i] = _cell(pixels[i, 1], n_rows) * n_columns + _cell(pixels[i, 0], n_columns)
        starts[cells[i] + 1] += 1
    starts = np.cumsum(starts)
    next_slot, order = starts[:-1].copy(), np.empty(len(pixels), np.int64)
    for i in range(len(pixels)):
        order[next_slot[cells[i]]] = i
        next_slot[cells[i]] += 1
    return order, starts


@part
def _keep_nearest(near: Ints, apart: Array, n: int) -> None:
    """Leave the nearest of `n` features in front, nearest first; where equal, the first ones."""
    for i in range(1, n):
        one, d2 = near[i], apart[i]
        k = min(i, N_NEAREST)
        while k > 0 and apart[k - 1] > d2:
            if k < N_NEAREST:
                near[k], apart[k] = near[k - 1], apart[k - 1]
            k -= 1
        if k < N_NEAREST:
            near[k], apart[k] = one, d2


@compiled(integers, integer, integer)
def find_both(ids: Ints, one: int, other: int) -> tuple[int, int, bool]:
    """First index of an id, -1 if absent, its number, and whether another id is there, too."""
    first, n, there = -1, 0, False
    for i in range(len(ids)):
        if ids[i] == one:
            first = i if n == 0 else first
            n += 1
        there |= ids[i] == other
    return first, n, there


@compiled(
    pairs, integers, words, integers, numbers, single_pairs, words, integers,
    number, number, integer,
)  # fmt: skip
def search(
    projected: Array, ids: Ints, point_words: Words, levels: Ints, radius: Array,
    pixels: Floats, feature_words: Words, octaves: Ints,
    max_distance: float, ratio: float, max_octave_gap: int,
) -> tuple[Ints, Ints]:  # fmt: skip
    """Indices into `ids` (M,) and features, each at most once, ordered by feature.

    `projected` (M, 2), `levels` (M,) and `radius` (M,) are of the points `ids`, `point_words` (P,
    4) of all points; the others of the features (N,).
    """
    n = len(pixels)
    right, bottom = 0.0, 0.0
    for i in range(n):
        right, bottom = max(right, pixels[i, 0]), max(bottom, pixels[i, 1])
    n_columns, n_rows = int(right / CELL_PX) + 1, int(bottom / CELL_PX) + 1
    order, starts = _in_cells(pixels, n_columns, n_rows)
    across, down, levels_of = np.empty(n), np.empty(n), np.empty(n, np.int64)
    for k in range(n):  # of a cell they lie together
        across[k], down[k] = pixels[order[k], 0], pixels[order[k], 1]
        levels_of[k] = octaves[order[k]]
    near, apart = np.empty(n + 1, np.int64), np.empty(n + 1)
    bits = np.empty(N_NEAREST, np.float32)
    taken_by, taken_for = np.full(n, -1, np.int64), np.full(n, _FAR)
    for m in range(len(ids)):
        x, y, r = projected[m, 0], projected[m, 1], radius[m]
        n_near = 0
        for row in range(_cell(y - r, n_rows), _cell(y + r, n_rows) + 1):
            first = row * n_columns + _cell(x - r, n_columns)
            last = row * n_columns + _cell(x + r, n_columns)
            for at in range(starts[first], starts[last + 1]):
                dx, dy = across[at] - x, down[at] - y
                d2 = dx * dx + dy * dy
                near[n_near], apart[n_near] = at, d2
                n_near += not d2 > r * r
        if n_near > N_NEAREST:
            _keep_nearest(near, apart, n_near)
            n_near = N_NEAREST
        best = -1
        for k in range(n_near):
            bits[k] = _FAR
            if abs(levels_of[near[k]] - levels[m]) <= max_octave_gap:
                bits[k] = _differing_bits(point_words[ids[m]], feature_words[order[near[k]]])
            if bits[k] <= max_distance and (
                best < 0
                or bits[k] < bits[best]
                or (bits[k] == bits[best] and apart[k] < apart[best])
            ):
                best = k
        if best < 0:
            continue
        # ratio test within one level only: adjacent levels show the same corner
        feature, second_best = order[near[best]], _FAR
        for k in range(n_near):
            if k != best and levels_of[near[k]] == levels_of[near[best]]:
                second_best = min(second_best, bits[k])
        if bits[best] < np.float32(ratio) * second_best and bits[best] < taken_for[feature]:
            taken_by[feature], taken_for[feature] = m, bits[best]
    found = np.flatnonzero(taken_by >= 0)
    return taken_by[found], found


@compiled(words, words, number, number)
def search_mutual(
    words_a: Words, words_b: Words, max_distance: float, ratio: float
) -> tuple[Ints, Ints]:
    """Mutually best features of two images by descriptor alone, ordered by the first; ties: first.

    The best of a row passes `max_distance` and, by `ratio`, the second best of that row.
    """
    n_b, far = len(words_b), 1000
    best_of_a = np.full(len(words_a), -1, np.int64)
    bits_of_a, second_of_a = np.full(len(words_a), far), np.full(len(words_a), far)
    best_of_b, bits_of_b = np.full(n_b, -1, np.int64), np.full(n_b, far)
    bits = np.empty(n_b, np.int64)
    for a in range(len(words_a)):
        for b in range(n_b):
            bits[b] = _differing_bits(words_a[a], words_b[b])
        best, first, second = -1, far, far
        for b in range(n_b):
            if bits[b] < second:
                if bits[b] < first:
                    best, first, second = b, bits[b], first
                else:
                    second = bits[b]
            if bits[b] < bits_of_b[b]:
                best_of_b[b], bits_of_b[b] = a, bits[b]
        best_of_a[a], bits_of_a[a], second_of_a[a] = best, first, second
    good = np.zeros(len(words_a), np.bool_)
    for a in range(len(words_a)):
        if best_of_a[a] >= 0 and best_of_b[best_of_a[a]] == a and bits_of_a[a] <= max_distance:
            good[a] = np.float32(bits_of_a[a]) < np.float32(ratio) * np.float32(second_of_a[a])
    found = np.flatnonzero(good)
    return found, best_of_a[found]


@compiled(
    single_pairs, single_pairs, numbers, words, words, integers, integers, integer, integer, number
)  # fmt: skip
def search_along(
    lines: Floats, rays: Floats, reach: Array, words_a: Words, words_b: Words, octaves_a: Ints,
    octaves_b: Ints, max_octave_gap: int, max_distance: int, ratio: float,
) -> tuple[Ints, Ints]:  # fmt: skip
    """Mutually best features of two images near epipolar lines, ordered by the first.

    Those of the second, by their `rays` (Nb, 3), must lie within `reach` (Nb,) of the `lines` (Na,
    3) of the first.
    """
    n, far = len(rays), 1000
    best_of_a, bits_of_a = np.full(len(lines), -1, np.int64), np.full(len(lines), far, np.int64)
    second_of_a = np.full(len(lines), far, np.int64)
    best_of_b, bits_of_b = np.full(n, -1, np.int64), np.full(n, far, np.int64)
    # along rows, and what is left of the last run beyond reach
    n_runs = -(-n // RUN)
    along, within = np.zeros((3, n_runs * RUN), np.float32), np.zeros(n_runs * RUN)
    along[:, :n], within[:n] = rays.T, reach
    off = np.empty(RUN, np.float32)
    for a in range(len(lines)):
        x, y, z = lines[a, 0], lines[a, 1], lines[a, 2]
        for start in range(0, n_runs * RUN, RUN):
            n_near = 0
            for k in range(RUN):
                off[k] = abs(
                    x * along[0, start + k] + y * along[1, start + k] + z * along[2, start + k]
                )
                n_near += off[k] < within[start + k]
            if n_near == 0:
                continue
            for k in range(RUN):
                b = start + k
                if not off[k] < within[b] or abs(octaves_a[a] - octaves_b[b]) > max_octave_gap:
                    continue
                bits = _differing_bits(words_a[a], words_b[b])
                if bits < bits_of_a[a]:
                    second_of_a[a] = bits_of_a[a]
                    best_of_a[a], bits_of_a[a] = b, bits
                elif bits < second_of_a[a]:
                    second_of_a[a] = bits
                if bits < bits_of_b[b]:
                    best_of_b[b], bits_of_b[b] = a, bits
    good = np.zeros(len(lines), np.bool_)
    for a in range(len(lines)):
        b = best_of_a[a]
        if b >= 0 and best_of_b[b] == a and bits_of_a[a] <= max_distance:
            good[a] = bits_of_a[a] < ratio * second_of_a[a]
    found = np.flatnonzero(good)
    return found, best_of_a[found]
