"""Boards that images show instead of the one that was asked for."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from companion.messages import Bytes

N_FIRST = 50
"""Markers of each dictionary tried, to identify the one of a board."""
MAX_TRIED = 4
"""Images searched for other boards, when the given one was not found."""


def dictionaries() -> list[str]:
    """Names of the dictionaries of markers."""
    names = [name for name in dir(cv2.aruco) if name.startswith("DICT_") and name == name.upper()]
    # of dictionaries with common first markers the smaller one first
    return sorted(
        names, key=lambda name: (name.rpartition("_")[0], len(dictionary_of(name).bytesList))
    )


def dictionary_of(name: str) -> cv2.aruco.Dictionary:
    """Dictionary of markers by its name."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def some_of(greys: Sequence[Bytes]) -> list[Bytes]:
    """Images that are searched for other boards, from the first to the last."""
    n = min(MAX_TRIED, len(greys))
    at = np.unique(np.linspace(0, len(greys) - 1, n).round().astype(int))
    return [greys[i] for i in at]


def markers_seen(greys: Sequence[Bytes], dictionary: cv2.aruco.Dictionary) -> set[int]:
    """Numbers of the markers in images that show at least two."""
    detector = cv2.aruco.ArucoDetector(dictionary)
    seen: set[int] = set()
    for grey in greys:
        _, ids, _ = detector.detectMarkers(grey)
        if ids is not None and len(ids) >= 2:
            seen |= {int(number) for number in np.ravel(ids)}
    return seen


def other_dictionary(greys: Sequence[Bytes]) -> str | None:
    """A dictionary of which an image shows enough markers not to be chance."""
    families: dict[str, tuple[str, cv2.aruco.Dictionary]] = {}
    for name in dictionaries():
        stem, _, count = name.rpartition("_")
        full = dictionary_of(name)
        # the smallest of those with common first markers, which boards use
        first = cv2.aruco.Dictionary(
            full.bytesList[:N_FIRST], full.markerSize, full.maxCorrectionBits
        )
        families.setdefault(stem if count.isdigit() else name, (name, first))
    for grey in greys:
        counts = {name: len(markers_seen([grey], first)) for name, first in families.values()}
        best = max(counts, key=lambda name: counts[name])
        if counts[best] >= 4:
            return f"markers of {best} are to be seen, {counts[best]} of them in one picture"
    return None


def chessboard_seen(greys: Sequence[Bytes], own: tuple[int, int] | None = None) -> str | None:
    """A chessboard in an image; of a board with markers, of `own` inner corners, its squares."""
    for grey in greys:
        found, _, meta = cv2.findChessboardCornersSBWithMeta(grey, (3, 3), cv2.CALIB_CB_LARGER)
        if not found or meta is None:
            continue
        rows, columns = sorted(np.asarray(meta).shape[:2])
        if own is None or rows > min(own) or columns > max(own):
            return f"a chessboard of {columns}x{rows} inner corners is to be seen"
        return "squares are to be seen, but no markers: bring the board nearer, and focus the lens"
    return None
