"""Places of the body by inertial navigation at the latest frames: what another map goes on from."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from companion.estimation.inertial.inertial_motion import InertialStart
from companion.geometry.transforms import Array

MAX_PLACES = 900
"""In a row, one a frame: half a minute at 30 a second."""


class BodyPlace(NamedTuple):
    """Place (3,) of the body by inertial navigation, world NED, metres; its motion by the same.

    `rotation` (3, 3) is its attitude in the frame of the navigation, by the autopilot, and
    `sigma_m` the standard deviation of the place per axis.
    """

    t_ns: int
    place_world_m: Array
    start: InertialStart
    rotation: Array
    sigma_m: float


class ReckonedPath:
    """Keeps these places in the frame of one world."""

    def __init__(self) -> None:
        self._places: deque[BodyPlace] = deque(maxlen=MAX_PLACES)

    def add(self, place: BodyPlace) -> None:
        """Add the place of the newest frame."""
        self._places.append(place)

    def at(self, t_ns: int) -> BodyPlace | None:
        """The place at one of the latest frames; None if that had none."""
        return next((each for each in self._places if each.t_ns == t_ns), None)

    def clear(self) -> None:
        """Forget all, where another world begins."""
        self._places.clear()
