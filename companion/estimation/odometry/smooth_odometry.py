"""Smooth odometry of the body, for an autopilot to fly on.

Scale, heading and position of the map are refined continuously, and each refinement moves the pose
of a stationary camera. Here the pose is continuous, and corrections are slew-limited.
"""

from __future__ import annotations

import numpy as np

from companion.estimation.body.aiding import AidedPlace
from companion.estimation.body.body_filter import BodyFilter, Reckoned
from companion.estimation.body.reckoning import BodyAttitude, Reckoning
from companion.estimation.camera_motion import SIGMA_DEAD_RECKONING_M_S, ImageVelocity
from companion.estimation.georeference.trajectory_alignment import SIGMA_YAW_RAD
from companion.estimation.lift_off.ground_aiding import GroundAiding
from companion.estimation.odometry.flown_map import FlownMap, LastPose
from companion.estimation.odometry.innovation_gate import MIN_CONSISTENT_NS, InnovationGate
from companion.estimation.odometry.lift_off_heading import LiftOffHeading
from companion.estimation.odometry.odometry_drift import OdometryDrift
from companion.estimation.odometry.odometry_frame import MapView, OdometryState, drift_m
from companion.estimation.odometry.placed_map import PlacedMap, frame_of
from companion.estimation.odometry.stand import FLOOR_M, FRESH_NS, SIGMA_ATTITUDE_RAD, Stand
from companion.estimation.odometry.tracked_velocity import tracked_velocity
from companion.estimation.odometry.tracking_quality import quality_of
from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose
from companion.messages import Georeference, Odometry, Track, TrackState

QUALITY_MARGIN = 1.5
"""Below this, times the least quality that is sent, good inertial navigation counts for more: a
vehicle that turns on the spot sees new ground without parallax."""
SIGMA_DOUBTED_M, SIGMA_DOUBTED_M_S = 0.1, 0.1
"""At least, of inertial navigation that a wrong map has aided."""
YOUNG_NS = 2_000_000_000
"""A map of a take-off grows by ten keyframes a second, and their adjustment lags behind: until then
it bends. Flown on at once in the firmwares' simulators, poses were off by 0.7 m after four metres
of climb in one take-off of three, with 0.1 m stated."""
CONTRADICTS_SIGMAS = 4.0
"""Beyond, a new map that is off from inertial navigation is wrong, not navigation; what that was
off by without aid in the firmwares' simulators was 2.5 of them at most."""
MAX_SIGMA_SCALE_AIDING = 0.05
"""Of a map that aids inertial navigation: with a worse scale it would give a wrong velocity."""
FLOOR_RAD = np.radians(0.3)
NOISE_INFLATION = 3.0
"""Inflation for correlated errors of the matches of one image."""


class SmoothOdometry:
    """Tracks of the active map and its georeference in, Odometry out; one per frame.

    Tracked places aid the inertial navigation, which carries the pose on where nothing is tracked.
    """

    def __init__(
        self, camera: Camera, max_jump_m: float, body: BodyFilter,
        min_quality: int = 1,
    ) -> None:  # fmt: skip
        mount = camera.body_from_camera
        self._flown = FlownMap(mount.inverse() if mount is not None else Pose.identity())
        self._size = np.array([camera.width, camera.height], np.float64)
        self._gate = InnovationGate(max_jump_m)
        self._drift = OdometryDrift()
        self._body = body
        self._least_quality = QUALITY_MARGIN * min_quality
        self.reckoning = Reckoning(body)
        self._velocity = np.zeros(3)
        self._dead_reckoning = False
        self._given = False
        """True once a pose was given out."""
        self.ground = GroundAiding(body)
        """From a stand up to a metric map."""
        self._stand = Stand()
        self._heading = LiftOffHeading()
        self.reset_counter = 0

    def step(
        self,
        track: Track,
        segment: int,
        georeference: Georeference | None,
        velocity_map: ImageVelocity | None,
        first: MapView | None = None,
    ) -> Odometry:
        """Odometry of the frame that has begun.

        `segment` identifies the map of the track, `georeference` is that of this map,
        `velocity_map` the camera's velocity in it, and `first` its first view.
        """
        found = (
            self._standing(track)
            if self.ground.stood is not None
            else self._of_map(track, segment, georeference, velocity_map, first)
        )
        self._given = self._given or found.world_from_body is not None
        return found

    def _of_map(
        self, track: Track, segment: int, georeference: Georeference | None,
        velocity_map: ImageVelocity | None, first: MapView | None,
    ) -> Odometry:  # fmt: skip
        pose, reckoned = track.map_from_camera, self.reckoning.reckoned
        known = track.state in (TrackState.TRACKING, TrackState.DEAD_RECKONING)
        if not known or pose is None or georeference is None:
            return self._unknown(track)
        if self._flown.last is not None and track.t_ns <= self._flown.last.t_ns:
            return self._none(track)  # late: a pose without it was given meanwhile
        active = self._flown.placed
        if active is None or segment != active.segment:
            goes_on = reckoned is not None or self._given
            if goes_on and georeference.sigma_scale > MAX_SIGMA_SCALE_AIDING:
                return self._unknown(track)  # it would also be slower and faster than the body
            if first is not None and track.t_ns - first.t_ns < YOUNG_NS and self.reckoning.is_good:
                return self._unknown(track)
            if not self._start_map(segment, georeference, pose, first):
                return self._unknown(track)
        elif georeference is not active.georeference:
            ratio = self._flown.georeferenced(georeference)
            if self._flown.last is not None:
                place_m = self._flown.last.place_m
                self._body.move(np.eye(3), place_m, place_m, ratio)
        assert self._flown.placed is not None
        raw = self._flown.placed.world_from_body(pose)
        if track.state is TrackState.DEAD_RECKONING:
            if reckoned is not None:
                return self._unknown(track)
            return self._dead_reckon(track, pose, raw, georeference)
        quality = quality_of(track, self._size)
        if quality < self._least_quality and self.reckoning.is_good:
            return self._unknown(track)
        if self._dead_reckoning:
            self._reacquire(raw, track.t_ns)
        frame, last = self._flown.frame, self._flown.last
        here, attitude = frame.from_world @ raw, self.reckoning.attitude
        if last is not None:
            dt_s = min((track.t_ns - last.t_ns) * 1e-9, 1.0)
            span_s = 0.0 if first is None else (track.t_ns - first.t_ns) * 1e-9
            within_m = drift_m(georeference.residual_m, span_s)
            frame = self._heading.turned(
                frame.slewed(raw, dt_s, within_m), track.t_ns, raw,
                None if attitude is None else attitude.ned_from_body, self.reset_counter, dt_s,
            )  # fmt: skip
        placed = frame.from_world @ raw
        within_gate = last is None or self._gate.reachable(
            last.place_m, placed.translation, track.t_ns - last.t_ns, self._velocity
        )
        if not within_gate and not self._gate.agree(placed.translation, track.t_ns, self._velocity):
            return self._unknown(track)
        self._flown.frame = frame
        ceased = reckoned is None and self._gate.refused_ns(track.t_ns) >= MIN_CONSISTENT_NS
        if not within_gate or ceased:
            self._reset()
        self._gate.clear()
        self._body.move(
            placed.rotation @ here.rotation.T, here.translation, placed.translation, 1.0
        )
        noise_m = NOISE_INFLATION * track.sigma_position * georeference.world_from_map.scale
        if attitude is not None and georeference.sigma_scale < MAX_SIGMA_SCALE_AIDING:
            turned = placed.rotation @ attitude.ned_from_body.T
            self._body.aid(AidedPlace(attitude.t_ns, placed.translation, turned, noise_m))
            self.ground.map_aided(track.t_ns)
        to_world = georeference.world_from_map
        found = tracked_velocity(
            None if attitude is None else self._body.moving(attitude.t_ns), velocity_map,
            to_world.scale * frame.from_world.rotation @ to_world.rotation, noise_m,
        )  # fmt: skip
        self._velocity, sigma_velocity = found or (self._velocity, float("inf"))
        self._flown.last = LastPose(track.t_ns, pose, placed)
        drift = self._drift.add(
            track.t_ns, placed.translation, georeference.sigma_scale, frame.slewed_m
        )
        return Odometry(
            track.seq, track.t_ns, track.state, self.reset_counter,
            quality, placed, self._velocity.copy(),
            float(np.linalg.norm([FLOOR_M, noise_m, *drift])),
            sigma_velocity,
            float(np.hypot(FLOOR_RAD, NOISE_INFLATION * track.sigma_rotation_rad)),
            self._sigma_yaw_rad(georeference, NOISE_INFLATION * track.sigma_rotation_rad),
            sigma_scale=georeference.sigma_scale, sigma_by_scale_m=drift.by_scale_m,
        )  # fmt: skip

    def _reset(self) -> None:
        """Begin poses that are unrelated to those before."""
        self.reset_counter += 1
        self._drift.clear()
        self._body.reset()

    def _sigma_yaw_rad(self, georeference: Georeference | None, noise_rad: float) -> float:
        """Standard deviation of the heading against north.

        Of the georeference, of the difference to it that is not slewed yet, and noise; before there
        is one, of the autopilot's heading.
        """
        sigma_rad = float(SIGMA_YAW_RAD) if georeference is None else georeference.sigma_yaw_rad
        return float(np.linalg.norm([FLOOR_RAD, noise_rad, sigma_rad, self._flown.frame.yaw_rad]))

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
            if world_m is not None and not self._stand.in_world:
                self._stand_in_world(world_m)
            if self.ground.stood is None:
                self._begin_stand(t_ns)
            self.ground.stand(attitude.t_ns, self._place_now())
        elif not standing:
            if self.ground.stood is not None:
                self._heading.lift_off(t_ns, self.reset_counter, self.ground.stood.place_m)
            self.ground.fly(
                t_ns if attitude is None else attitude.t_ns,
                float(self._place_now()[2]), self.ground.wants_flow(t_ns),
                None if attitude is None else float(attitude.ned_from_body[2, 2]),
            )  # fmt: skip
        self.reckoning.begin(t_ns, attitude, self._flown.frame.from_world)
        return self.reckoning.reckoned

    def without_frame(self, seq: int, t_ns: int, attitude: BodyAttitude | None) -> Odometry | None:
        """Odometry at a time without a frame; None where inertial navigation knows none.

        Nor at a stand: that it lasts takes a picture to say.
        """
        if self.ground.stood is not None or not self._given:
            return None
        if self.begin(t_ns, attitude) is None:
            return None
        return self._unknown(Track(seq, t_ns, TrackState.LOST))

    def _dead_reckon(
        self, track: Track, pose: Pose, raw: Pose, georeference: Georeference
    ) -> Odometry:
        """Odometry by dead reckoning: of lowest quality and growing uncertainty."""
        placed, last = self._flown.frame.from_world @ raw, self._flown.last
        if last is not None:
            dt_s = max((track.t_ns - last.t_ns) * 1e-9, 1e-3)
            self._velocity = (placed.translation - last.place_m) / dt_s
        self._dead_reckoning = True
        self._flown.last = LastPose(track.t_ns, pose, placed)
        scale = georeference.world_from_map.scale
        return Odometry(
            track.seq, track.t_ns, track.state, self.reset_counter, 1, placed,
            self._velocity.copy(), max(FLOOR_M, scale * track.sigma_position),
            SIGMA_DEAD_RECKONING_M_S, float(np.hypot(FLOOR_RAD, track.sigma_rotation_rad)),
            self._sigma_yaw_rad(georeference, track.sigma_rotation_rad),
        )  # fmt: skip

    def _reacquire(self, raw: Pose, t_ns: int) -> None:
        """Reacquisition after dead reckoning: continue from its pose, if close enough.

        What the pose is then off by is slewed away.
        """
        self._dead_reckoning, last = False, self._flown.last
        if last is None:
            return
        expected = last.place_m + self._velocity * ((t_ns - last.t_ns) * 1e-9)
        if self.reckoning.reckoned is not None:
            expected = self.reckoning.reckoned.place_m
        correction = expected - (self._flown.frame.from_world @ raw).translation
        if float(np.linalg.norm(correction)) < self._gate.max_jump_m:
            self._flown.frame = self._flown.frame.shifted(correction)

    def place_in_map(self, place_m: Array, map_from_camera: Array) -> Array | None:
        """Place of the camera (3,) in the active map; see `FlownMap.place_of_camera`."""
        return self._flown.place_of_camera(place_m, map_from_camera)

    def _none(self, track: Track) -> Odometry:
        """Odometry without a pose."""
        return Odometry(track.seq, track.t_ns, track.state, self.reset_counter)

    def _unknown(self, track: Track) -> Odometry:
        """Odometry without a pose by the map: by inertial navigation, as far as that knows it."""
        attitude, reckoned = self.reckoning.attitude, self.reckoning.reckoned
        if attitude is None or reckoned is None:
            return self._none(track)
        placed = Pose(self.reckoning.rotation(attitude), reckoned.place_m)
        self._velocity, self._dead_reckoning = reckoned.velocity_m_s, True
        georeference, slewed_m = self._flown.georeference, self._flown.frame.slewed_m
        sigma_scale = 0.0 if georeference is None else georeference.sigma_scale
        self._flown.hold(track.t_ns, placed)
        drift = self._drift.add(track.t_ns, placed.translation, sigma_scale, slewed_m)
        return Odometry(
            track.seq, track.t_ns, TrackState.DEAD_RECKONING, self.reset_counter, 1, placed,
            reckoned.velocity_m_s,
            float(np.linalg.norm([FLOOR_M, reckoned.sigma_place_m, *drift])),
            reckoned.sigma_velocity_m_s, SIGMA_ATTITUDE_RAD,
            self._sigma_yaw_rad(georeference, SIGMA_ATTITUDE_RAD), inertial=True,
            sigma_scale=sigma_scale, sigma_by_scale_m=drift.by_scale_m,
        )  # fmt: skip

    def _begin_stand(self, t_ns: int) -> None:
        """Begin a stand where the body is; a reset where that is not known any more."""
        reckoned, last, sigma_m = self.reckoning.reckoned, self._flown.last, float("inf")
        if reckoned is not None:
            sigma_m = reckoned.sigma_place_m
        elif last is not None and t_ns - last.t_ns <= FRESH_NS:
            sigma_m = 0.0
        if not self._stand.begin(sigma_m, self._given):
            self._reset()

    def _stand_in_world(self, world_m: Array) -> None:
        """Stand where satellites have the body (3,), so that their map goes on from there.

        A reset, if it stood elsewhere before.
        """
        self._stand.begins_m, self._stand.in_world = world_m, True
        self._flown.last = self.ground.stood = None
        self.reckoning.clear()
        self._body.reset()

    def _place_now(self) -> Array:
        """Place (3,) of the body as far as it is known: where it begins, if not at all."""
        if self.reckoning.reckoned is not None:
            return self.reckoning.reckoned.place_m
        last = self._flown.last
        return self._stand.begins_m if last is None else last.place_m

    def _standing(self, track: Track) -> Odometry:
        """Odometry of a vehicle that stands on the ground: at a fixed place, as the attitude is.

        The first waits until inertial navigation could carry it on: an autopilot that arms on it
        would lose it at lift-off.
        """
        attitude, fixed = self.reckoning.attitude, self.ground.stood
        assert fixed is not None
        if attitude is None:
            return self._none(track)
        if not self._given and self._body.at(track.t_ns) is None:
            return Odometry(track.seq, track.t_ns, TrackState.STANDING, self.reset_counter)
        placed = Pose(fixed.world_from_attitude @ attitude.ned_from_body, fixed.place_m)
        self._velocity, self._dead_reckoning = np.zeros(3), True
        self._flown.hold(track.t_ns, placed)
        sigma_yaw_rad = self._sigma_yaw_rad(self._flown.georeference, SIGMA_ATTITUDE_RAD)
        return self._stand.odometry(track, self.reset_counter, placed, sigma_yaw_rad)

    def _start_map(
        self, segment: int, georeference: Georeference, pose: Pose, first: MapView | None
    ) -> bool:
        """Start in another map, or the first one: see `frame_of`.

        False where it contradicts inertial navigation, which is certain enough to know better: by
        a wrong mount, say. Flown on in the firmwares' simulators, such maps took the vehicle away.
        """
        placed = PlacedMap(segment, georeference, self._flown.camera_from_body)
        reckoned, last = self.reckoning.reckoned, self._flown.last
        frame, goes_on, off_m = frame_of(
            placed, pose, first, self._flown.frame,
            None if first is None else self.reckoning.path.at(first.t_ns),
            None if reckoned is None else reckoned.place_m,
            None if last is None else last.place_m, self._gate.max_jump_m,
        )  # fmt: skip
        if (
            not goes_on and off_m is not None and not georeference.has_origin
            and reckoned is not None and off_m > CONTRADICTS_SIGMAS * reckoned.sigma_place_m
        ):  # fmt: skip
            return False
        self._stand.in_world |= georeference.has_origin
        if not goes_on:
            self.reset_counter += self._given
            self._drift.clear()
            if last is not None and georeference.has_origin:
                self._body.reset()
        self.reckoning.path.clear()
        self._flown.begin(placed, frame, pose)
        self._dead_reckoning = False
        self._gate.clear()
        return True

    @property
    def state(self) -> OdometryState | None:
        """State to continue from; None before the first pose."""
        frame, last = self._flown.frame, self._flown.last
        if last is None:
            return None
        return OdometryState(
            frame.from_world, frame.anchored, last.place_m.copy(), self._velocity.copy()
        )

    def resume(self, segment: int, georeference: Georeference, state: OdometryState) -> None:
        """Continue in a stored frame; `segment` and `georeference` are of the map stored with it.

        The next pose is taken as is, since the motion meanwhile is unknown.
        """
        placed = PlacedMap(segment, georeference, self._flown.camera_from_body)
        self._flown.resume(placed, state.odometry_from_world, state.anchored)
        self._dead_reckoning = False
        self._gate.clear()
        self._drift.clear()
        self._body.reset()

    def forget_reckoned(self) -> None:
        """Forget inertial navigation, and where it had the body: the accelerations were wrong."""
        self._body.forget()
        self.reckoning.clear()

    def discard_map(self, segment: int, tilt_rad: float) -> None:
        """Handle a map that was found tilted: what aided inertial navigation was tilted, too.

        It is doubted by as much as that has turned the way since the map began, and the velocity.
        """
        active = self._flown.placed
        if active is None or segment != active.segment or self._flown.last is None:
            return
        share, way_m = float(np.sin(min(tilt_rad, np.pi / 2))), self._flown.way_m()
        speed_m_s = float(np.linalg.norm(self._velocity))
        self._body.doubt(SIGMA_DOUBTED_M + share * way_m, SIGMA_DOUBTED_M_S + share * speed_m_s)

    def correct_map(self, segment: int, t_ns: int, map_from_camera: Pose) -> None:
        """Apply a correction of a map: `map_from_camera` of its last tracked frame now.

        The output stays continuous; the difference is slewed. A frame that the gate refused, or of
        another map, says nothing of the pose that was given.
        """
        active, last = self._flown.placed, self._flown.last
        if last is None or active is None or self._dead_reckoning:
            return  # what dead reckoning is off by shows when the map is seen again
        if segment == active.segment and t_ns == last.t_ns:
            self._flown.corrected(map_from_camera)
