"""Starts of the smooth odometry in a map: a new one, a stored one, one that is seen again."""

from __future__ import annotations

import numpy as np

from companion.estimation.body.limits import CONTRADICTS_SIGMAS
from companion.estimation.odometry.odometry_course import OdometryCourse
from companion.estimation.odometry.odometry_frame import MapView, OdometryState
from companion.estimation.odometry.placed_map import PlacedMap, frame_of
from companion.estimation.odometry.stand import Stand
from companion.geometry.transforms import Pose
from companion.messages import Georeference, Track

YOUNG_NS = 2_000_000_000
"""A map of a take-off grows by ten keyframes a second, and their adjustment lags behind: until then
it bends. Flown on at once in the firmwares' simulators, poses were off by 0.7 m after four metres
of climb in one take-off of three, with 0.1 m stated."""


class MapStarts:
    """Goes on in another map than that of the pose before."""

    def __init__(self, course: OdometryCourse, stand: Stand) -> None:
        self._course, self._stand = course, stand

    def start(
        self, segment: int, georeference: Georeference, track: Track, pose: Pose,
        first: MapView | None,
    ) -> bool:  # fmt: skip
        """Start in another map, or the first one, where that is good enough yet: see `frame_of`.

        False also where it contradicts inertial navigation, which is certain enough to know better:
        by a wrong mount, say. Flown on in the firmwares' simulators, such maps took the vehicle
        away.
        """
        course = self._course
        reckoned, last = course.reckoning.reckoned, course.flown.last
        goes_on = reckoned is not None or course.given
        young = first is not None and track.t_ns - first.t_ns < YOUNG_NS
        rough = goes_on and course.rough(georeference.sigma_scale)
        if young and (rough or course.reckoning.is_good):
            return False
        if rough and (course.reckoning.is_fair or reckoned is None):
            return False
        placed = PlacedMap(segment, georeference, course.flown.camera_from_body)
        start = frame_of(
            placed, pose, first, course.flown.frame,
            None if first is None else course.reckoning.path.at(first.t_ns),
            reckoned, None if last is None else last.place_m, course.gate.max_jump_m,
        )  # fmt: skip
        if (
            not start.goes_on and start.off_m is not None and not georeference.has_origin
            and reckoned is not None and start.off_m > CONTRADICTS_SIGMAS * reckoned.sigma_place_m
        ):  # fmt: skip
            return False
        self._stand.in_world |= georeference.has_origin
        sigma_m = 0.0 if reckoned is None else reckoned.sigma_place_m
        if start.goes_on and sigma_m < course.gate.max_jump_m:
            course.drift.carry(sigma_m)
        else:  # it jumps, or may have done so unseen
            course.reset_counter += course.given
            course.drift.clear()
        if not start.goes_on and last is not None and georeference.has_origin:
            course.body.reset()
        course.reckoning.path.clear()
        course.flown.begin(placed, start, pose)
        course.dead_reckoning = False
        course.gate.clear()
        return True

    def resume(self, segment: int, georeference: Georeference, state: OdometryState) -> None:
        """Continue in a stored frame; `segment` and `georeference` are of the map stored with it.

        The next pose is taken as is, since the motion meanwhile is unknown.
        """
        course = self._course
        placed = PlacedMap(segment, georeference, course.flown.camera_from_body)
        course.flown.resume(placed, state.odometry_from_world, state.anchored)
        course.dead_reckoning = False
        course.gate.clear()
        course.drift.clear()
        course.body.reset()

    def reacquire(self, raw: Pose, t_ns: int) -> None:
        """Reacquisition after dead reckoning: continue from its pose, if close enough.

        What the pose, the body's in the world, is then off by is slewed away.
        """
        course, last = self._course, self._course.flown.last
        course.dead_reckoning = False
        if last is None:
            return
        expected = last.place_m + course.velocity * ((t_ns - last.t_ns) * 1e-9)
        if course.reckoning.reckoned is not None:
            expected = course.reckoning.reckoned.place_m
        correction = expected - (course.flown.frame.from_world @ raw).translation
        off_m = float(np.linalg.norm(correction))
        if off_m < course.gate.max_jump_m:
            course.drift.carry(off_m / float(np.sqrt(3.0)))
            course.flown.frame = course.flown.frame.shifted(correction)
