"""Where in a picture a level roof may show, so that it need not be looked for everywhere."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

TILE_PX = 16


class Reach:
    """Where in a picture a level may show, by tiles of it: most of it meets no roof.

    `rays` (3, H, W) are in NED.
    """

    def __init__(self, rays: np.ndarray) -> None:
        height, width = rays.shape[1:]
        self._tops, self._lefts = np.arange(0, height, TILE_PX), np.arange(0, width, TILE_PX)
        slopes = rays[:2] / rays[2]
        least, most = (
            each.reduceat(each.reduceat(slopes, self._tops, 1), self._lefts, 2)
            for each in (np.minimum, np.maximum)
        )
        self._ranges = least, most

    def part(
        self, centre: np.ndarray, height: float, place: Sequence[float] | np.ndarray
    ) -> tuple[slice, slice] | None:
        """Rows and columns from the first to the last that may show a level; None without any.

        The level is at a down coordinate, from (north, east) to (north, east).
        """
        least, most = self._ranges
        down = height - float(centre[2])
        corners = np.array(place).reshape(2, 2, 1, 1) - centre[:2].reshape(2, 1, 1)
        low, high = np.sort(corners / down, 0) + np.array([-1e-3, 1e-3]).reshape(2, 1, 1, 1)
        tiles = ~((most < low) | (least > high)).any(0)  # nan, at the horizon, is no reason
        rows, columns = tiles.any(1).nonzero()[0], tiles.any(0).nonzero()[0]
        if not len(rows):
            return None
        top, left = self._tops[rows[0]], self._lefts[columns[0]]
        below, right = self._tops[rows[-1]] + TILE_PX, self._lefts[columns[-1]] + TILE_PX
        return slice(top, below), slice(left, right)
