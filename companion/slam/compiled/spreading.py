"""Selection of corners evenly distributed over an image."""

from __future__ import annotations

import numpy as np

from companion.messages import Floats
from companion.slam.compiled.compiling import (
    Ints,
    compiled,
    given,
    integer,
    number,
    single,
    single_pairs,
)


@compiled(single_pairs, given(single, 1), number, integer)
def spread(pixels: Floats, response: Floats, cell_px: float, n_wanted: int) -> Ints:
    """Indices, ascending: the strongest of every cell in turn, until there are enough.

    Ties resolve to the first.
    """
    n = len(pixels)
    if n <= n_wanted:
        return np.arange(n)
    right, bottom = 0.0, 0.0
    for i in range(n):
        right, bottom = max(right, pixels[i, 0]), max(bottom, pixels[i, 1])
    n_columns = int(right / cell_px) + 1
    strongest = np.argsort(-response, kind="mergesort")
    in_cell = np.zeros(n_columns * (int(bottom / cell_px) + 1), np.int64)
    of_rank, rank = np.zeros(n + 1, np.int64), np.empty(n, np.int64)
    for i in strongest:
        cell = int(pixels[i, 1] / cell_px) * n_columns + int(pixels[i, 0] / cell_px)
        rank[i] = in_cell[cell]
        in_cell[cell] += 1
        of_rank[rank[i]] += 1
    last, left = 0, n_wanted
    while of_rank[last] <= left:
        left -= of_rank[last]
        last += 1
    chosen = rank < last
    for i in strongest:
        if left > 0 and rank[i] == last:
            chosen[i] = True
            left -= 1
    return np.flatnonzero(chosen)
