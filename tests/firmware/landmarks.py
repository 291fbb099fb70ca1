"""Landmarks of a scene besides its boxes: a marker to land on, a wall to stop before."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from companion.geometry.transforms import Array
from tests.firmware.boxes import Box

MARKER_ID, MARKER_M = 7, 0.5
FAMILY, FAMILY_WORD = cv2.aruco.DICT_APRILTAG_36h11, "apriltag_36h11"
CELLS, MARGIN_CELLS = 8, 1
"""Along the edge of the black square, and of white about it."""
BOARD_M = 0.02
"""Thickness of the board that it is printed on: above the ground, so that both never mix."""
WHITE = np.array([1.55, 1.66, 2.2])
"""Tint of plain faces: of the mean colour of the ground it makes white."""
BLACK = 0.05 * WHITE
PLAIN = 2.0
"""Instead of 1 for "ground" and 0 for "face with the ground's texture"."""
WALL_HALF_M = 0.5, 14.0
WALL_HEIGHT_M = 14.0
"""Higher than it is flown at, so that the camera sees no sky above it."""


@dataclass(frozen=True, slots=True)
class Landmarks:
    """Metres from where the vehicle stands, north and east; None where there is none."""

    marker: tuple[float, float] | None = None
    """Middle of a marker that lies level, its upper edge to the north."""
    wall_north: float | None = None
    """Of the near face of a wall across the way to the north."""

    def walls(self) -> list[Box]:
        """As boxes."""
        if self.wall_north is None:
            return []
        half_north, half_east = WALL_HALF_M
        return [Box(self.wall_north + half_north, 0.0, half_north, half_east, WALL_HEIGHT_M)]

    def triangles(self) -> Array:
        """Vertices (N, 9) of the marker as `boxes.triangles_of` has them."""
        if self.marker is None:
            return np.zeros((0, 9))
        side = CELLS + 2 * MARGIN_CELLS
        cells = np.full((side, side), 255, np.uint8)
        dictionary = cv2.aruco.getPredefinedDictionary(FAMILY)
        cells[MARGIN_CELLS:-MARGIN_CELLS, MARGIN_CELLS:-MARGIN_CELLS] = (
            cv2.aruco.generateImageMarker(dictionary, MARKER_ID, CELLS)
        )
        cell_m = MARKER_M / CELLS
        north, east = self.marker
        rows = []
        for (row, column), grey in np.ndenumerate(cells):
            corners = np.array([(row, column), (row, column + 1),
                                (row + 1, column + 1), (row + 1, column)])  # fmt: skip
            off = cell_m * (corners - 0.5 * side)
            places = np.c_[north - off[:, 0], east + off[:, 1], np.full(4, -BOARD_M)]
            tint = WHITE if grey else BLACK
            face = np.c_[places, np.zeros((4, 2)), np.tile(tint, (4, 1)), np.full(4, PLAIN)]
            rows.append(face[[0, 1, 2, 0, 2, 3]])
        return np.concatenate(rows)


def landmarks_of(words: str) -> Landmarks:
    """Of `marker:NORTH:EAST` and `wall:NORTH`, separated by commas; "" for none."""
    marker = wall_north = None
    for word in filter(None, words.split(",")):
        kind, *numbers = word.split(":")
        if kind == "marker":
            marker = float(numbers[0]), float(numbers[1])
        elif kind == "wall":
            wall_north = float(numbers[0])
        else:
            raise ValueError(f"no landmark: {word}")
    return Landmarks(marker, wall_north)
