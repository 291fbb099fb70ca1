"""A vehicle that stands on the ground: where, how certainly, and its odometry."""

from __future__ import annotations

import numpy as np

from companion.estimation.lift_off.ground_aiding import SIGMA_STANDING_M_S, GroundAiding
from companion.estimation.odometry.odometry_course import (
    FLOOR_M,
    SIGMA_ATTITUDE_RAD,
    OdometryCourse,
)
from companion.geometry.transforms import Array, Pose
from companion.messages import Odometry, Track, TrackState

FRESH_NS, MAX_SIGMA_M = 300_000_000, 0.3
"""Of the place of a landing: older, or less certain, the place where it stands is another one."""


class Stand:
    """Place of the stand that began last, and what is known of it."""

    def __init__(self, course: OdometryCourse, ground: GroundAiding) -> None:
        self._course, self._ground = course, ground
        self._begins_m: Array = np.zeros(3)
        """Place (3,) of a stand before any other is known."""
        self.in_world = False
        """True once satellites have placed the body, or its map."""
        self._sigma_m = 0.0
        """Of the place, since the last reset."""

    def stand(self, t_ns: int, stamp_ns: int, world_m: Array | None) -> None:
        """Take a frame that stands, by its time and the autopilot's, and its place by satellites.

        That is (3,), None where there are none.
        """
        if world_m is not None and not self.in_world:
            self._stand_in_world(world_m)
        if self._ground.stood is None:
            self._begin(t_ns)
        self._ground.stand(stamp_ns, self.place_now())

    def _begin(self, t_ns: int) -> None:
        """Begin a stand where the body is; a reset where that is not known any more."""
        course = self._course
        reckoned, last, sigma_m = course.reckoning.reckoned, course.flown.last, float("inf")
        if reckoned is not None:
            sigma_m = reckoned.sigma_place_m
        elif last is not None and t_ns - last.t_ns <= FRESH_NS:
            sigma_m = last.sigma_m
        known = sigma_m <= MAX_SIGMA_M
        self._sigma_m = sigma_m if course.given and known else 0.0
        if course.given and not known:  # the first place needs no certainty
            course.reset()

    def _stand_in_world(self, world_m: Array) -> None:
        """Stand where satellites have the body (3,), so that their map goes on from there.

        A reset, if it stood elsewhere before.
        """
        self._begins_m, self.in_world = world_m, True
        self._course.flown.last = self._ground.stood = None
        self._course.reckoning.clear()
        self._course.body.reset()

    def place_now(self) -> Array:
        """Place (3,) of the body as far as it is known: where it begins, if not at all."""
        reckoned, last = self._course.reckoning.reckoned, self._course.flown.last
        if reckoned is not None:
            return reckoned.place_m
        return self._begins_m if last is None else last.place_m

    def odometry(self, track: Track) -> Odometry:
        """Odometry of a vehicle that stands on the ground: at a fixed place, as the attitude is.

        The first waits until inertial navigation could carry it on: an autopilot that arms on it
        would lose it at lift-off.
        """
        course, fixed = self._course, self._ground.stood
        attitude = course.reckoning.attitude
        assert fixed is not None
        if attitude is None:
            return course.none(track)
        if not course.given and course.body.at(track.t_ns) is None:
            return Odometry(track.seq, track.t_ns, TrackState.STANDING, course.reset_counter)
        placed = Pose(fixed.world_from_attitude @ attitude.ned_from_body, fixed.place_m)
        course.velocity, course.dead_reckoning = np.zeros(3), True
        course.flown.hold(track.t_ns, placed, self._sigma_m)
        georeference = course.flown.georeference
        sigma_scale = 0.0 if georeference is None else georeference.sigma_scale
        slewed_m = course.flown.frame.slewed_m
        drift = course.drift.add(track.t_ns, fixed.place_m, sigma_scale, slewed_m)
        return Odometry(
            track.seq, track.t_ns, TrackState.STANDING, course.reset_counter, 100, placed,
            np.zeros(3), float(np.linalg.norm([FLOOR_M, self._sigma_m, *drift])),
            SIGMA_STANDING_M_S, SIGMA_ATTITUDE_RAD,
            course.sigma_yaw_rad(georeference, SIGMA_ATTITUDE_RAD),
            sigma_by_scale_m=drift.by_scale_m,
        )  # fmt: skip
