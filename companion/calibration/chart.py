"""Calibration boards: description, detection, printing.

Board coordinates are metres, x right and y down from the upper left corner of the board, z = 0.
Pixel centres are at integers. Only inner corners are used, which are detected to some hundredths of
a pixel.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.calibration.board_edges import edge_px, refined_corners
from companion.calibration.other_boards import (
    chessboard_seen,
    dictionaries,
    dictionary_of,
    markers_seen,
    other_dictionary,
    some_of,
)
from companion.errors import InputError
from companion.geometry.transforms import Array
from companion.messages import Bytes

CHART_FORMS = (
    "charuco:COLUMNSxROWS:SQUARE_M:MARKER_M:DICTIONARY, as charuco:7x5:0.04:0.03:DICT_5X5_100 "
    "(squares counted), or chessboard:COLUMNSxROWS:SQUARE_M, as chessboard:9x6:0.025 "
    "(inner corners counted)"
)
MIN_CORNERS = 8
"""Corners required of a detection."""
SEARCH_WIDTH_PX = 1600
"""Larger images are searched for a chessboard at this width, then refined at full size."""


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """A detected board: inner corners in the image and on the board."""

    ids: NDArray[np.int64]
    """Corner numbers, row by row."""
    image_px: Array
    """Corners (N, 2), pixels."""
    board_m: Array
    """The same corners (N, 3) on the board, metres."""
    edge_px: float
    """Width of black-white edges, in the direction where they are widest."""


class Chart(Protocol):
    """A flat board."""

    name: str
    """As given, in the form read by `parse_chart`."""
    columns: int
    """Inner corners in a row."""
    rows: int
    square_m: float

    def find(self, grey: Bytes) -> Detection | None:
        """Detect the board in an image; None if not found."""

    def explain(self, greys: Sequence[Bytes]) -> str | None:
        """Contents of grey images without the board, as a clause; None if unknown."""

    def black_m(self) -> Array:
        """Black rectangles (N, 4) x, y, width, height in metres."""


def parse_chart(text: str) -> Chart:
    """The board of a description; InputError where invalid."""
    kind, *parts = text.strip().split(":")
    size = re.fullmatch(r"(\d+)x(\d+)", parts[0]) if parts else None
    if kind not in ("charuco", "chessboard") or size is None:
        raise InputError(f"--board {text}: wanted {CHART_FORMS}")
    columns, rows = int(size[1]), int(size[2])
    if not (3 <= columns <= 50 and 3 <= rows <= 50):
        raise InputError(f"--board {text}: wanted 3 to 50 columns and rows")
    if kind == "chessboard":
        if len(parts) != 2:
            raise InputError(f"--board {text}: wanted {CHART_FORMS}")
        return ChessboardChart(text.strip(), columns, rows, _length(text, parts[1]))
    legacy = parts[4:] == ["legacy"]
    if len(parts) != (5 if legacy else 4):
        raise InputError(f"--board {text}: wanted {CHART_FORMS}")
    square_m, marker_m = _length(text, parts[1]), _length(text, parts[2])
    if not 0.3 * square_m <= marker_m <= 0.95 * square_m:
        raise InputError(f"--board {text}: the marker must be 0.3 to 0.95 of the square")
    name = parts[3].upper()
    if name not in dictionaries():
        raise InputError(
            f"--board {text}: unknown dictionary; known are " + ", ".join(dictionaries())
        )
    if columns * rows // 2 > len(dictionary_of(name).bytesList):
        raise InputError(
            f"--board {text}: it has {columns * rows // 2} markers, {name} only "
            f"{len(dictionary_of(name).bytesList)}"
        )
    return CharucoChart(text.strip(), columns, rows, square_m, marker_m, name, legacy)


class CharucoChart:
    """A chessboard with markers in its white squares: a partial view suffices."""

    def __init__(
        self, name: str, n_across: int, n_down: int, square_m: float, marker_m: float,
        dictionary: str, legacy: bool,
    ) -> None:  # fmt: skip
        self.name = name
        self.columns, self.rows = n_across - 1, n_down - 1
        self.square_m, self.marker_m = square_m, marker_m
        self._dictionary, self._legacy = dictionary, legacy
        # OpenCV uses float32 lengths: in units of squares they are exact enough
        self._board = cv2.aruco.CharucoBoard(
            (n_across, n_down), 1.0, marker_m / square_m, dictionary_of(dictionary)
        )
        self._board.setLegacyPattern(legacy)
        careful = cv2.aruco.CharucoParameters()
        careful.tryRefineMarkers = True
        self._detector = cv2.aruco.CharucoDetector(self._board, careful)

    def find(self, grey: Bytes) -> Detection | None:
        """Detect the board, possibly partly visible; None if not found."""
        corners, ids, _, _ = self._detector.detectBoard(grey)
        if ids is None or len(ids) < MIN_CORNERS:
            return None
        numbers = np.asarray(ids, np.int64).reshape(-1)
        order = np.argsort(numbers)
        image_px = np.asarray(corners, np.float64).reshape(-1, 2)[order]
        return _detection(self, grey, numbers[order], image_px)

    def explain(self, greys: Sequence[Bytes]) -> str | None:
        """Contents of grey images without the board, as a clause; None if unknown."""
        tried = some_of(greys)
        seen = markers_seen(tried, dictionary_of(self._dictionary))
        if not seen:
            return other_dictionary(tried) or chessboard_seen(tried, (self.columns, self.rows))
        for other in self._variants():
            if any(other.find(grey) is not None for grey in tried):
                return f"what is to be seen is --board {other.name}"
        n_markers = len(self._board.getIds())
        if max(seen) >= n_markers:
            return (
                f"markers up to number {max(seen)} of {self._dictionary} are to be seen, this "
                f"board has {n_markers} (0 to {n_markers - 1}): it has other columns and rows"
            )
        return (
            f"markers of {self._dictionary} are to be seen, but too few of them ({len(seen)} of "
            f"{n_markers}), blurred, or not where this board has them"
        )

    def black_m(self) -> Array:
        """Black rectangles (N, 4), metres."""
        out = []
        corners = np.asarray(self._board.getObjPoints(), np.float64)[..., :2]  # (markers, 4, 2)
        numbers = np.ravel(np.asarray(self._board.getIds()))
        white = {tuple(at): i for i, at in enumerate(corners.mean(1).astype(int).tolist())}
        for row in range(self.rows + 1):
            for column in range(self.columns + 1):
                i = white.get((column, row))
                if i is None:
                    out.append([column, row, 1.0, 1.0])
                else:
                    out += _marker(
                        dictionary_of(self._dictionary),
                        int(numbers[i]),
                        corners[i, 0],
                        corners[i, 2],
                    )
        return np.array(out, np.float64) * self.square_m

    def _variants(self) -> list[CharucoChart]:
        """Variants that are often confused."""
        across, down = self.columns + 1, self.rows + 1
        out = []
        for columns, rows, legacy in (
            (down, across, self._legacy),
            (across, down, not self._legacy),
            (down, across, not self._legacy),
        ):
            name = (
                f"charuco:{columns}x{rows}:{self.square_m:g}:{self.marker_m:g}:{self._dictionary}"
                + (":legacy" if legacy else "")
            )
            out.append(
                CharucoChart(
                    name, columns, rows, self.square_m, self.marker_m, self._dictionary, legacy
                )
            )
        return out


class ChessboardChart:
    """A plain chessboard, which must be fully visible."""

    def __init__(self, name: str, columns: int, rows: int, square_m: float) -> None:
        self.name = name
        self.columns, self.rows, self.square_m = columns, rows, square_m

    def find(self, grey: Bytes) -> Detection | None:
        """Detect the board, fully visible; None if not found."""
        scale = max(1.0, grey.shape[1] / SEARCH_WIDTH_PX)
        small = grey
        if scale > 1:
            small = np.asarray(
                cv2.resize(grey, None, fx=1 / scale, fy=1 / scale, interpolation=cv2.INTER_AREA),
                np.uint8,
            )
        found, corners = cv2.findChessboardCornersSB(
            small, (self.columns, self.rows), flags=cv2.CALIB_CB_NORMALIZE_IMAGE
        )
        if not found:
            return None
        image_px = (np.asarray(corners, np.float64).reshape(-1, 2) + 0.5) * scale - 0.5
        image_px = refined_corners(grey, image_px, self.columns)
        return _detection(self, grey, np.arange(self.columns * self.rows), image_px)

    def explain(self, greys: Sequence[Bytes]) -> str | None:
        """Contents of grey images without the board, as a clause; None if unknown."""
        tried = some_of(greys)
        return other_dictionary(tried) or chessboard_seen(tried)

    def black_m(self) -> Array:
        """Black rectangles (N, 4), metres."""
        squares = [
            [column, row, 1.0, 1.0]
            for row in range(self.rows + 1)
            for column in range(self.columns + 1)
            if (row + column) % 2 == 0
        ]
        return np.array(squares, np.float64) * self.square_m


def _length(text: str, word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not 1e-4 <= value <= 10:
        raise InputError(f"--board {text}: {word!r} is no length in metres; wanted {CHART_FORMS}")
    return value


def _marker(
    dictionary: cv2.aruco.Dictionary, number: int, first: Array, last: Array
) -> list[list[float]]:
    """Black rectangles of a marker, in the units of its corners, merged by row."""
    n = dictionary.markerSize + 2
    black = dictionary.generateImageMarker(number, n) == 0
    step = (last - first) / n
    out = []
    for row in range(n):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], black[row], [False]]).astype(int)))
        for begin, end in edges.reshape(-1, 2):
            out.append([
                first[0] + begin * step[0], first[1] + row * step[1],
                (end - begin) * step[0], step[1],
            ])  # fmt: skip
    return out


def _detection(
    chart: Chart, grey: Bytes, ids: NDArray[np.int64], image_px: Array
) -> Detection | None:
    """Detection from corners; None where they are in a single row."""
    column, row = ids % chart.columns, ids // chart.columns
    if len(np.unique(column)) < 2 or len(np.unique(row)) < 2:
        return None
    board_m = np.stack([column + 1.0, row + 1.0, 0.0 * row], 1) * chart.square_m
    return Detection(ids, image_px, board_m, edge_px(grey, ids, image_px, chart.columns))
