"""Smooth odometry of the body, for an autopilot to fly on.

Scale, heading and position of the map are refined continuously, and each refinement moves the pose
of a stationary camera. Here the pose is continuous, and corrections are slew-limited.
"""

from __future__ import annotations

import numpy as np

from companion.estimation.body.aiding import AidedPlace
from companion.estimation.body.body_filter import BodyFilter
from companion.estimation.body.body_state import Reckoned
from companion.estimation.body.reckoning import BodyAttitude
from companion.estimation.camera_motion import ImageVelocity
from companion.estimation.lift_off.ground_aiding import GroundAiding
from companion.estimation.odometry.flown_map import LastPose
from companion.estimation.odometry.jump_gate import MIN_CONSISTENT_NS
from companion.estimation.odometry.lift_off_heading import LiftOffHeading
from companion.estimation.odometry.map_starts import MapStarts
from companion.estimation.odometry.odometry_course import (
    FLOOR_M,
    FLOOR_RAD,
    OdometryCourse,
)
from companion.estimation.odometry.odometry_frame import (
    MapView,
    OdometryFrame,
    OdometryState,
    drift_m,
)
from companion.estimation.odometry.stand import Stand
from companion.estimation.odometry.standing_picture import StandingPicture
from companion.estimation.odometry.tracked_velocity import tracked_velocity
from companion.estimation.odometry.tracking_quality import FoundAgain, quality_of
from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose, yaw_angle, yaw_rotation
from companion.messages import Georeference, Odometry, Track, TrackState
from companion.slam.features.orb_features import Ints

QUALITY_MARGIN = 1.5
"""Below this, times the least quality that is sent, good inertial navigation counts for more: a
vehicle that turns on the spot sees new ground without parallax."""
SIGMA_DOUBTED_M, SIGMA_DOUBTED_M_S = 0.1, 0.1
"""At least, of inertial navigation that a wrong map has aided."""
NOISE_INFLATION = 3.0
"""Inflation for correlated errors of the matches of one image: those of the points they share."""


class SmoothOdometry:
    """Tracks of the active map and its georeference in, Odometry out; one per frame.

    Tracked places aid the inertial navigation, which carries the pose on where nothing is tracked.
    """

    def __init__(
        self, camera: Camera, max_jump_m: float, body: BodyFilter,
        min_quality: int = 1,
    ) -> None:  # fmt: skip
        mount = camera.body_from_camera
        self._mounted = mount is not None
        self._course = OdometryCourse(
            mount.inverse() if mount is not None else Pose.identity(), max_jump_m, body
        )
        self._size = np.array([camera.width, camera.height], np.float64)
        self._least_quality = QUALITY_MARGIN * min_quality
        self.reckoning = self._course.reckoning
        self.ground = GroundAiding(body)
        """From a stand up to a metric map."""
        self._stand = Stand(self._course, self.ground)
        self._starts = MapStarts(self._course, self._stand)
        self._heading = LiftOffHeading()
        self.found_again = FoundAgain()
        self._aided_by: int | None = None
        """The map that aided inertial navigation last."""
        self.standing_picture = StandingPicture()

    def begin(
        self, t_ns: int, attitude: BodyAttitude | None, standing: bool = False,
        world_m: Array | None = None,
    ) -> Reckoned | None:  # fmt: skip
        """Go on by inertial navigation to the next frame, with its attitude where that is known.

        Where the body should be then, in the frame of the odometry; None where unknown, or too
        uncertain to be of use. `standing` where the vehicle stands on the ground, and `world_m`
        (3,) its place by satellites, where there are any.
        """
        if standing and attitude is not None:
            self._stand.stand(t_ns, attitude.t_ns, world_m)
        elif not standing:
            if self.ground.stood is not None:
                counter = self._course.reset_counter
                self._heading.lift_off(t_ns, counter, self.ground.stood.place_m)
            self.ground.fly(
                t_ns if attitude is None else attitude.t_ns,
                float(self._stand.place_now()[2]), self.ground.wants_flow(t_ns),
                None if attitude is None else float(attitude.ned_from_body[2, 2]),
            )  # fmt: skip
        self.reckoning.begin(t_ns, attitude, self._course.flown.frame.from_world)
        return self.reckoning.reckoned

    def step(
        self,
        track: Track,
        segment: int,
        georeference: Georeference | None,
        velocity_map: ImageVelocity | None,
        first: MapView | None = None,
        born: Ints | None = None,
    ) -> Odometry:
        """Odometry of the frame that has begun.

        `segment` identifies the map of the track, `georeference` is that of this map,
        `velocity_map` the camera's velocity in it, and `first` its first view. `born` (N,) are the
        keyframes at which the points in view were made.
        """
        self._course.drift.see(born)
        quality = quality_of(track, self._size)
        self.found_again.see(track, segment, quality)
        found = (
            self._stand.odometry(track)
            if self.ground.stood is not None
            else self._of_map(track, segment, georeference, velocity_map, first, quality)
        )
        self._course.given = self._course.given or found.world_from_body is not None
        return found

    def without_frame(self, seq: int, t_ns: int, attitude: BodyAttitude | None) -> Odometry | None:
        """Odometry at a time without a frame; None where inertial navigation knows none.

        Nor at a stand: that it lasts takes a picture to say.
        """
        if self.ground.stood is not None or not self._course.given:
            return None
        if self.begin(t_ns, attitude) is None:
            return None
        return self._course.reckoned(Track(seq, t_ns, TrackState.LOST))

    def _of_map(
        self, track: Track, segment: int, georeference: Georeference | None,
        velocity_map: ImageVelocity | None, first: MapView | None, quality: int,
    ) -> Odometry:  # fmt: skip
        """Odometry by the map; by inertial navigation where that is better, or no map known."""
        course, flown = self._course, self._course.flown
        pose = track.map_from_camera
        known = track.state in (TrackState.TRACKING, TrackState.DEAD_RECKONING)
        if not known or pose is None:
            return course.reckoned(track)
        attitude, active = self.reckoning.attitude, flown.placed
        if attitude is not None and (active is None or segment != active.segment):
            body_from_map = (pose.rotation @ flown.camera_from_body.rotation).T
            self._heading.foresee(track.t_ns, segment, attitude.ned_from_body @ body_from_map)
        if georeference is None:
            return course.reckoned(track)
        if flown.last is not None and track.t_ns <= flown.last.t_ns:
            return course.none(track)  # late: a pose without it was given meanwhile
        if active is None or segment != active.segment:
            if not self._starts.start(segment, georeference, track, pose, first):
                return course.reckoned(track)
        elif georeference is not active.georeference:
            ratio = flown.georeferenced(georeference)
            if flown.last is not None:
                course.body.rescale(flown.last.place_m, ratio, georeference.sigma_scale)
        assert flown.placed is not None
        raw = flown.placed.world_from_body(pose)
        if track.state is TrackState.DEAD_RECKONING:
            if self.reckoning.reckoned is not None:
                return course.reckoned(track)
            return course.dead_reckoned(track, pose, raw, georeference)
        doubtful = course.rough(georeference.sigma_scale) or not self.found_again.certain
        if (doubtful and self.reckoning.is_fair) or (
            quality < self._least_quality and self.reckoning.is_good
        ):
            return course.reckoned(track)
        image_m = track.sigma_position * georeference.world_from_map.scale
        noise_m = NOISE_INFLATION * image_m
        here = flown.frame.from_world @ raw  # also where dead reckoning was off
        if self.standing_picture.stands(
            track.t_ns, here.translation, self.reckoning.reckoned, course.body.refuses
        ):
            self._aid(track.t_ns, here, georeference, noise_m)
            return course.none(Track(track.seq, track.t_ns, TrackState.LOST))
        seen_again = course.dead_reckoning
        if seen_again:
            self._starts.reacquire(raw, track.t_ns)
        frame = self._corrected_frame(track.t_ns, raw, georeference, first)
        placed = frame.from_world @ raw
        if not self._accepted(track.t_ns, placed.translation, seen_again):
            return course.reckoned(track)
        flown.frame = frame
        course.body.move(placed.rotation @ here.rotation.T, here.translation, placed.translation)
        if attitude is not None:
            turned = pose.rotation @ flown.camera_from_body.rotation
            course.body.turn(attitude.t_ns, segment, turned)
        self._aid(track.t_ns, placed, georeference, noise_m)
        to_world = georeference.world_from_map
        found = tracked_velocity(
            None if attitude is None else course.body.moving(attitude.t_ns), velocity_map,
            to_world.scale * frame.from_world.rotation @ to_world.rotation, noise_m,
        )  # fmt: skip
        course.velocity, sigma_velocity = found or (course.velocity, float("inf"))
        flown.last = LastPose(track.t_ns, pose, placed, noise_m)
        return self._given(track, placed, georeference, image_m, sigma_velocity, quality)

    def _corrected_frame(
        self, t_ns: int, raw: Pose, georeference: Georeference, first: MapView | None
    ) -> OdometryFrame:
        """Frame of the odometry with a body at `raw` in the world, slewed as time allows."""
        flown, attitude = self._course.flown, self.reckoning.attitude
        if flown.last is None:
            return flown.frame
        dt_s = min((t_ns - flown.last.t_ns) * 1e-9, 1.0)
        span_s = 0.0 if first is None else (t_ns - first.t_ns) * 1e-9
        within_m = drift_m(georeference.residual_m, span_s)
        return self._heading.turned(
            flown.frame.slewed(raw, dt_s, within_m), t_ns, raw,
            None if attitude is None else attitude.ned_from_body, self._course.reset_counter, dt_s,
        )  # fmt: skip

    def _accepted(self, t_ns: int, place_m: Array, seen_again: bool) -> bool:
        """True if the gate lets a place (3,) pass, after a reset where the pose jumps to it."""
        course, last = self._course, self._course.flown.last
        within_gate = last is None or course.gate.reachable(
            last.place_m, place_m, t_ns - last.t_ns, course.velocity
        )
        as_reckoned = seen_again and self.reckoning.may_be_at(place_m)
        if not (within_gate or as_reckoned or course.gate.agree(place_m, t_ns, course.velocity)):
            return False
        refused_long = course.gate.refused_ns(t_ns) >= MIN_CONSISTENT_NS
        if not within_gate or (refused_long and self.reckoning.reckoned is None):
            course.reset()
        course.gate.clear()
        return True

    def _given(
        self, track: Track, placed: Pose, georeference: Georeference, image_m: float,
        sigma_velocity: float, quality: int,
    ) -> Odometry:  # fmt: skip
        """A tracked pose of the body with its uncertainty; `image_m` is that by the image alone."""
        course, sigma_scale = self._course, georeference.sigma_scale
        drift = course.drift.add(
            track.t_ns, placed.translation, sigma_scale, course.flown.frame.slewed_m, image_m
        )  # without the errors of points: what the drift hands on
        noise_rad = NOISE_INFLATION * track.sigma_rotation_rad
        return Odometry(
            track.seq, track.t_ns, track.state, course.reset_counter,
            quality, placed, course.velocity.copy(),
            float(np.linalg.norm([FLOOR_M, NOISE_INFLATION * image_m, *drift])),
            float(np.hypot(sigma_velocity, course.sigma_by_scale_m_s(sigma_scale))),
            float(np.hypot(FLOOR_RAD, noise_rad)) if self._mounted else float("inf"),
            course.sigma_yaw_rad(georeference, noise_rad),
            sigma_scale=sigma_scale, sigma_by_scale_m=drift.by_scale_m,
        )  # fmt: skip

    def _aid(self, t_ns: int, placed: Pose, georeference: Georeference, noise_m: float) -> None:
        """Aid inertial navigation by a tracked pose, unless it is better than the map's scale."""
        attitude, sigma_scale = self.reckoning.attitude, georeference.sigma_scale
        worse = self.reckoning.reckoned is not None and not self.reckoning.is_fair
        if attitude is not None and (worse or not self._course.rough(sigma_scale)):
            # images err in tilt for seconds: by as much as shifts a body in them as well
            turned = yaw_rotation(yaw_angle(placed.rotation @ attitude.ned_from_body.T))
            active = self._course.flown.placed
            segment = None if active is None else active.segment
            self._course.body.aid(AidedPlace(
                attitude.t_ns, placed.translation, turned, noise_m,
                sigma_scale if segment != self._aided_by else None,
            ))  # fmt: skip
            self._aided_by, self._course.aided_sigma_scale = segment, sigma_scale
            self.ground.map_aided(t_ns)

    def place_in_map(self, place_m: Array, map_from_camera: Array) -> Array | None:
        """Place of the camera (3,) in the active map; see `FlownMap.place_of_camera`."""
        return self._course.flown.place_of_camera(place_m, map_from_camera)

    @property
    def state(self) -> OdometryState | None:
        """State to continue from; None before the first pose."""
        frame, last = self._course.flown.frame, self._course.flown.last
        if last is None:
            return None
        velocity = self._course.velocity.copy()
        return OdometryState(frame.from_world, frame.anchored, last.place_m.copy(), velocity)

    def resume(self, segment: int, georeference: Georeference, state: OdometryState) -> None:
        """Continue in a stored frame; see `MapStarts.resume`."""
        self._starts.resume(segment, georeference, state)

    def forget_reckoned(self) -> None:
        """Forget inertial navigation, and where it had the body: the accelerations were wrong."""
        self._course.body.forget()
        self.reckoning.clear()

    def discard_map(self, segment: int, tilt_rad: float) -> None:
        """Handle a map that was found wrong: what aided inertial navigation was, too.

        It is doubted by as much as the tilt has turned the way since the map began, and the
        velocity.
        """
        flown, velocity = self._course.flown, self._course.velocity
        self.standing_picture.since_ns = None
        if flown.placed is None or segment != flown.placed.segment or flown.last is None:
            return
        share, way_m = float(np.sin(min(tilt_rad, np.pi / 2))), flown.way_m()
        speed_m_s = float(np.linalg.norm(velocity))
        self._course.body.doubt(
            SIGMA_DOUBTED_M + share * way_m, SIGMA_DOUBTED_M_S + share * speed_m_s
        )

    def correct_map(self, segment: int, t_ns: int, map_from_camera: Pose) -> None:
        """Apply a correction of a map: `map_from_camera` of its last tracked frame now.

        The output stays continuous; the difference is slewed. A frame that the gate refused, or of
        another map, says nothing of the pose that was given.
        """
        flown = self._course.flown
        if flown.last is None or flown.placed is None or self._course.dead_reckoning:
            return  # what dead reckoning is off by shows when the map is seen again
        if segment == flown.placed.segment and t_ns == flown.last.t_ns:
            flown.corrected(map_from_camera)
