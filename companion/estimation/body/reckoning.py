"""Place of the body by inertial navigation, frame by frame."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from companion.estimation.body.body_filter import BodyFilter
from companion.estimation.body.body_state import Reckoned
from companion.estimation.body.limits import CONTRADICTS_SIGMAS
from companion.estimation.body.reckoned_path import BodyPlace, ReckonedPath
from companion.geometry.transforms import Array, Pose

MAX_SIGMA_M = 5.0
"""Beyond, it is of no use even to find the map again."""
GOOD_SIGMA_M = 0.5
"""As long as it is this certain, it counts for more than a map that is poor."""
FAIR_SIGMA_M = 1.0
"""As long as it is this certain, it is sent, and counts for more than a map that may not have been
found, or whose scale is too uncertain to be sent."""


class BodyAttitude(NamedTuple):
    """Attitude `ned_from_body` (3, 3) of a frame, at its time by the autopilot's stamps."""

    t_ns: int
    ned_from_body: Array


class Reckoning:
    """Attitude of the frame that has begun, and the body by inertial navigation there."""

    def __init__(self, body: BodyFilter) -> None:
        self._body = body
        self.attitude: BodyAttitude | None = None
        self.reckoned: Reckoned | None = None
        """In the frame of the odometry; None where unknown, or too uncertain to be of use."""
        self.path = ReckonedPath()
        """Of the latest frames, in the world."""

    def begin(self, t_ns: int, attitude: BodyAttitude | None, odometry_from_world: Pose) -> None:
        """Go on to a frame, with its attitude where that is known."""
        found = None if attitude is None else self._body.at(attitude.t_ns)
        if found is not None and found.sigma_place_m > MAX_SIGMA_M:
            found = None
        self.attitude, self.reckoned = attitude, found
        if found is not None and attitude is not None:
            world_m = np.asarray(odometry_from_world.inverse().apply(found.place_m))
            start = found.start._replace(t_ns=t_ns)
            rotation, sigma_m = self.rotation(attitude), found.sigma_place_m
            self.path.add(BodyPlace(t_ns, world_m, start, rotation, sigma_m))

    def rotation(self, attitude: BodyAttitude) -> Array:
        """Rotation (3, 3) of a body in the frame of the odometry, by its attitude."""
        return np.asarray(self._body.world_from_attitude @ attitude.ned_from_body)

    @property
    def is_good(self) -> bool:
        """True where it counts for more than a map that is poor."""
        return self.reckoned is not None and self.reckoned.sigma_place_m < GOOD_SIGMA_M

    @property
    def is_fair(self) -> bool:
        """True where it counts for more than a map that may be wrong."""
        return self.reckoned is not None and self.reckoned.sigma_place_m < FAIR_SIGMA_M

    def may_be_at(self, place_m: Array) -> bool:
        """True where it may be off by the distance to a place (3,)."""
        reckoned = self.reckoned
        if reckoned is None:
            return False
        off_m = float(np.linalg.norm(place_m - reckoned.place_m))
        return off_m < CONTRADICTS_SIGMAS * reckoned.sigma_place_m

    def clear(self) -> None:
        """Forget where it had the body."""
        self.reckoned = None
        self.path.clear()
