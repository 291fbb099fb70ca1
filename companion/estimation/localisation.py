"""Localisation stage: frames and telemetry in; tracks, odometry, keyframes and map out.

The attitude predicts the next pose of the tracker, its keyframes georeference the map.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import astuple

import numpy as np

from companion.config import Config
from companion.estimation.attitude.camera_attitude import CameraAttitude
from companion.estimation.attitude_checks import AttitudeChecks
from companion.estimation.body.body_filter import BodyFilter
from companion.estimation.body_odometry import BodyOdometry
from companion.estimation.camera_motion import CameraMotion
from companion.estimation.camera_watch import CameraWatch
from companion.estimation.flow_of_frames import FlowOfFrames
from companion.estimation.gate.proof import MAP_RESUMED
from companion.estimation.georeference.georeferencer import Georeferencer
from companion.estimation.georeference.segment_georeference import SegmentGeoreferences
from companion.estimation.gimbal.gimbal_head import GimbalHead
from companion.estimation.inertial.acceleration_integral import AccelerationIntegral
from companion.estimation.inertial.judged_acceleration import JudgedAcceleration
from companion.estimation.lift_off.optical_flow import FlowMeter
from companion.estimation.lift_off.standing import Standing
from companion.estimation.odometry.smooth_odometry import SmoothOdometry
from companion.estimation.resumption.checkpoint import Checkpoint
from companion.estimation.resumption.map_resumption import MapResumption
from companion.estimation.satellites.satellite_watch import SatelliteWatch
from companion.estimation.site.site_in_flight import SiteInFlight
from companion.estimation.site.site_use import DOUBTED, SiteUse
from companion.estimation.telemetry_intake import TelemetryIntake
from companion.estimation.track_intake import TrackIntake
from companion.geometry.camera import Camera
from companion.geometry.geodesy import GeoOrigin
from companion.messages import (
    Bytes,
    Frame,
    FrameOverdue,
    FrameTracked,
    KeyframeAdded,
    LoopClosed,
    MapUpdate,
    Message,
    Track,
    TrackState,
)
from companion.slam.loop.loop_closure import LoopClosure
from companion.slam.map.site_map import SiteMap
from companion.slam.map.sparse_map import Keyframe, SlamMap
from companion.slam.mapping.far_keyframes import ArrayFile
from companion.slam.tracking.prior import Prior
from companion.slam.tracking.tracker import Tracker
from companion.telemetry import Telemetry
from companion.timing.clock import Timer

MAX_HEAD_TURN_RAD = np.radians(10.0)
"""Of a gimbal's head from where images have it to where it says it is: at 15 frames/s one that
begins to turn by 90 degrees a second is 6 degrees off."""


class LocalisationStage:
    """Localises the camera.

    With `background` keyframes are mapped in another thread, so that no frame waits; `order` is
    then that of mapping and frames, as FrameTracked told it in an earlier flight. In the map of a
    `site` it is located as soon as that is seen again. Of telemetry it believes what
    `telemetry.use` names, but no position estimates of an autopilot that flies on ours.
    """

    def __init__(
        self, config: Config, camera: Camera, times: Timer, *, background: bool = False,
        order: Iterable[int] | None = None, site: SiteUse | None = None,
    ) -> None:  # fmt: skip
        self._config = config
        self._camera = camera
        self._times = times
        self._tracker = Tracker(config, camera, times, background, order)
        self._attitude = CameraAttitude(camera.body_from_camera, camera.gimbal)
        self._gimbal = None if camera.gimbal is None else GimbalHead(camera.gimbal)
        self._motion = CameraMotion()
        self._georeferencer = Georeferencer(
            config.georeference,
            camera.body_from_camera,
            sensors_only=config.feedback.gives_position,
        )
        lever_m = None if camera.gimbal is None else np.array(camera.gimbal.place_body_m)
        reckoning = AccelerationIntegral(lever_m)
        of_scale = AccelerationIntegral(lever_m, reckoning.turns)
        self._standing = Standing()
        body = BodyFilter(reckoning)
        self._smooth = SmoothOdometry(
            camera, config.feedback.max_jump_m, body, config.feedback.min_quality
        )
        self._georeferences = SegmentGeoreferences(
            self._georeferencer, self._attitude, of_scale, camera.body_from_camera
        )
        self._odometry = BodyOdometry(
            self._tracker, self._attitude, self._gimbal, self._motion, self._georeferencer,
            self._georeferences, body, self._smooth,
        )  # fmt: skip
        self._checks = AttitudeChecks(
            self._attitude, self._tracker, self._motion, self._georeferences, self._smooth
        )
        self._imu = JudgedAcceleration((reckoning, of_scale), self._withdraw_accelerations)
        flow = FlowMeter(camera)
        self._flow = FlowOfFrames(
            config.feedback.flow != "off" and self._gimbal is None, flow, self._smooth.ground,
            self._attitude, self._checks, times,
        )  # fmt: skip
        self._satellites = SatelliteWatch(
            camera.camera_from_body, camera.body_from_camera is not None and not camera.assumed
        )
        self._tracks = TrackIntake(
            self._tracker, self._attitude, self._gimbal, self._motion, self._georeferences,
            self._odometry, self._smooth,
        )  # fmt: skip
        self._watch = CameraWatch(
            camera, config.features.n_features, self._tracker, self._attitude, self._motion,
            reckoning.level, times,
        )  # fmt: skip
        self._t_ns = 0
        self._telemetry = TelemetryIntake(
            config.telemetry.use, self._gimbal, self._standing, flow, self._smooth.ground,
            self._imu, self._satellites, self._attitude, self._georeferencer,
            self._georeferences.depths,
        )  # fmt: skip
        self._origin: GeoOrigin | None = None
        """The origin of local NED, where it was told since the last frame."""
        self._resumption = MapResumption(
            camera, config.features, self._tracker, self._attitude, self._motion,
            self._georeferences, self._smooth,
        )  # fmt: skip
        self._tracker.atlas.loop_allowed = self._loop_allowed
        self._georeferences.begun.reckoned_at = self._smooth.reckoning.path.at
        self._tracker.atlas.displacements_of = self._georeferences.displacements_of
        self._tracker.atlas.georeference_of = self._georeferences.of
        self._site = SiteInFlight(site, self._tracker, self._georeferencer, self._georeferences)

    @property
    def state(self) -> TrackState:
        """State of the tracker."""
        return self._tracker.state

    @property
    def n_segments(self) -> int:
        """Number of maps not connected to each other."""
        return len(self._segments())

    @property
    def n_loops(self) -> int:
        """Number of loops closed and maps merged."""
        return self._tracker.atlas.n_loops

    def step(self, message: Message | GeoOrigin) -> Iterable[Message]:
        """Process one message; messages come in order of time.

        The outputs of a frame are computed lazily, what its pose depends on and the pose first:
        exhaust the iterator.
        """
        if isinstance(message, Frame):
            return self._frame(message)
        if isinstance(message, FrameOverdue):
            return self._without_frame(message)
        if isinstance(message, GeoOrigin):
            self._origin = message
        elif isinstance(message, Telemetry):
            self._telemetry.add(message)
        return []

    def _take_samples(self) -> None:
        if self._origin is not None:
            self._site.take_origin(self._origin)
        self._telemetry.pass_on()

    def look_ahead(self, grey: Bytes) -> None:
        """Begin with the image (H, W) of a frame to come, in order: the very array of its step."""
        self._tracker.look_ahead(grey)

    def put_far_into(self, file: ArrayFile) -> None:
        """Put most of the keyframes that the newest have left behind into a file from now on."""
        self._tracker.atlas.far_file = file

    def set_effort(self, share: float) -> None:
        """Extract this ratio of the features from now on, under load."""
        self._tracker.extractor.feature_ratio = share

    def checkpoint(self) -> Checkpoint | None:
        """State to resume from in another process; None unless the last frame was tracked.

        A copy. None while a stored map is being verified, and with a scale while attitude, needed
        for verification, is missing.
        """
        with self._times("checkpoint"):
            return self._resumption.keep(self._t_ns)

    def resume(self, kept: Checkpoint, t_ns: int, absent_ns: int) -> None:
        """Start with a stored map, to be verified; before the first frame, at `t_ns`.

        Its scale and georeference are used once several frames agree. Its last frame was
        `absent_ns` ago.
        """
        self._resumption.begin(kept, t_ns, absent_ns)

    def finish(self, adjust: bool = True) -> list[Message]:
        """The map at the end of a flight, with or without a final global adjustment."""
        out: list[Message] = [*self._tracker.close()]
        self._take_samples()
        with self._times("final adjustment"):
            for segment in self._segments() if adjust else ():
                self._tracker.atlas.mapper_of(segment).finish()
        out += self._tracker.refined(is_over=True)
        if self._segments():
            out.append(self._georeferences.update(self._segments(), self._t_ns, final=True))
        return out

    def site_map(self, flight: str, origin: GeoOrigin | None) -> SiteMap | None:
        """The map of the site, of a flight that has finished; None without a scale.

        `flight` is its name, `origin` that of local NED.
        """
        return self._site.site_map(self._segments(), self._camera, flight, origin)

    def _segments(self) -> list[SlamMap]:
        return [s for s in self._tracker.segments if s.keyframes]

    def _frame(self, frame: Frame) -> Iterator[Message]:
        # one section for all of a frame: interleaved with mapping each would slow the other
        with self._tracker.map_lock.tracking():
            self._t_ns = frame.t_ns
            self._take_samples()
            # a process that is killed after the pose has told already what that came of
            yield self._frame_tracked(frame.t_ns, frame.seq, has_picture=True)
            frame = self._watch.begin(frame)
            for out in self._tracked(frame):
                yield self._watch.of(out, frame.seq)
            yield from self._watch.end(frame.seq)
            yield from self._tracker.refined()
        yield from self._flow.of(frame)

    def _without_frame(self, overdue: FrameOverdue) -> Iterator[Message]:
        """The pose by inertial navigation alone, where that is known."""
        t_ns = overdue.t_ns
        if t_ns <= self._t_ns:
            return
        with self._tracker.map_lock.tracking():
            self._take_samples()
            yield self._frame_tracked(t_ns, overdue.seq, has_picture=False)
            self._odometry.apply_map_correction()
            found = self._odometry.without_frame(overdue.seq, t_ns)
            if found is not None:
                yield found
            self._telemetry.prune(t_ns, self._segments())

    def _frame_tracked(self, t_ns: int, seq: int, has_picture: bool) -> FrameTracked:
        origin, self._origin = self._origin, None
        return FrameTracked(
            t_ns, seq, self._telemetry.n_samples, self._tracker.map_lock.point,
            self._tracker.extractor.feature_ratio, has_picture,
            None if origin is None or not self._site.in_use else astuple(origin),
        )  # fmt: skip

    def _tracked(self, frame: Frame) -> Iterator[Message]:
        attitude = self._attitude.at(frame.t_ns)
        self._odometry.apply_map_correction()
        if (
            self._gimbal is not None
            and attitude is not None
            and self._motion.turn_apart(frame.t_ns, attitude) > MAX_HEAD_TURN_RAD
        ):
            attitude = None  # told in other axes all at once: images alone keep what is tracked
        stands = self._standing.at(frame.t_ns, frame.grey)
        reckoned = self._odometry.begin(frame.t_ns, stands)
        if (stands or self._smooth.ground.low) and self.state is TrackState.INITIALISING:
            self._tracker.stand()
        predicted = self._odometry.predicted(frame.t_ns, attitude, reckoned)
        before = self._tracker.map
        aligned = predicted is not None and attitude is not None and self._motion.aligned
        rotation_in_map = predicted.rotation if predicted is not None and aligned else None
        tracked = self._tracker.step(frame, Prior(predicted, attitude, rotation_in_map))
        if any(isinstance(m, LoopClosed) for m in tracked):
            self._odometry.apply_map_correction()  # by this very frame, in lockstep
        other_map = self._tracker.map is not before
        if other_map or self.state is TrackState.INITIALISING:
            self._motion.reset()
            self._attitude.reset()
        # another map must be georeferenced before its first pose is published
        update = self._map_update() if other_map and self._segments() else None
        for message in tracked:
            if isinstance(message, Track):
                yield from self._tracks.take(message, message.seq == frame.seq, predicted)
            else:
                yield message
        due = any(isinstance(m, KeyframeAdded) for m in tracked)
        due |= self.state is TrackState.TRACKING and self._georeferences.stale(frame.t_ns)
        if update is None and due and self._segments():
            update = self._map_update()
        if update is not None:
            yield update
        resumed = self._resumption.frame(frame.t_ns)
        if resumed is not None:
            yield resumed
            if resumed.what == MAP_RESUMED:
                yield self._map_update()
        for warned in self._site.frame(frame.t_ns, self._tracks.seen):
            yield warned
            if warned.what == DOUBTED:
                yield self._map_update()
        yield from self._imu.warnings()
        yield from self._georeferencer.warnings()
        if not stands:
            track = next(m for m in tracked if isinstance(m, Track) and m.seq == frame.seq)
            yield from self._watch.limits(track)
            slam_map = self._tracker.map
            self._satellites.take_frame(
                frame.t_ns, slam_map.first_keyframe_id, self._tracks.seen,
                self._georeferences.of(slam_map), self._watch.near_limits,
            )  # fmt: skip
        yield from self._satellites.warnings()
        yield from self._checks.check(frame.t_ns)
        if self._gimbal is not None and self._attitude.used:
            yield from self._gimbal.warnings(frame.t_ns, attitude is not None)
        self._telemetry.prune(frame.t_ns, self._segments())

    def _map_update(self) -> MapUpdate:
        with self._times("georeference"):
            return self._georeferences.update(self._segments(), self._t_ns, final=False)

    def _withdraw_accelerations(self, since_ns: int) -> None:
        """Forget what accelerations since a time gave: they were wrong."""
        self._smooth.forget_reckoned()
        self._georeferences.withdraw_accelerations(since_ns)

    def _loop_allowed(self, keyframe: Keyframe, other: Keyframe, found: LoopClosure) -> bool:
        by_site = self._site.allowed(found)
        if by_site is not None:
            return by_site
        return self._georeferences.loop_allowed(self._tracker.map, keyframe, other, found)
