"""Detection of a picture that stands while the vehicle flies on.

A pattern that stands in the picture, dirt or the sensor's own, is tracked as well as ground is.
"""

from __future__ import annotations

import numpy as np

from companion.estimation.body.body_state import Reckoned
from companion.geometry.transforms import Array

LEAST_GONE_M, STANDS_RATIO = 0.25, 0.3
"""Way by inertial navigation since the map agreed with it, and of that what the map has of it at
most where it stands."""


class StandingPicture:
    """Compares ways by tracked poses of the body and by inertial navigation, since they agreed."""

    def __init__(self) -> None:
        self._seen_m: Array = np.zeros(3)
        self._reckoned_m: Array | None = None
        """Places (3,) by each where they agreed last; they may be some decimetres apart."""
        self.since_ns: int | None = None
        """Begin of the stand, None where there is none."""

    def stands(self, t_ns: int, place_m: Array, reckoned: Reckoned | None, refused: bool) -> bool:
        """True where tracked poses stand, and accelerometers say that the body has gone on.

        `place_m` (3,) is by a tracked pose; `refused` says that inertial navigation refuses those.
        """
        if not refused:
            self._seen_m, self.since_ns = place_m, None
            self._reckoned_m = None if reckoned is None else reckoned.place_m
        elif self.since_ns is None and reckoned is not None and self._reckoned_m is not None:
            seen_m = float(np.linalg.norm(place_m - self._seen_m))
            gone_m = float(np.linalg.norm(reckoned.place_m - self._reckoned_m))
            if gone_m > LEAST_GONE_M and seen_m < STANDS_RATIO * gone_m:
                self.since_ns = t_ns
        return self.since_ns is not None
