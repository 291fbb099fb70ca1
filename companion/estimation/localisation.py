"""The localisation stage: frames and telemetry in; tracks, keyframes and the map out.

It joins what must know each other in flight: the autopilot's attitude predicts the tracker's next
pose, the tracker's keyframes tell where the map lies in the world.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from companion.config import Config
from companion.estimation.camera_attitude import CameraAttitude
from companion.estimation.checkpoint import MOST_BYTES, Checkpoint
from companion.estimation.georeference import Georeferencer
from companion.estimation.motion_filter import MotionFilter
from companion.estimation.resumption import Resumption, Verdict
from companion.estimation.segment_georeference import SegmentPlaces
from companion.estimation.smooth_odometry import SIGMA_COASTING_M_S, SmoothOdometry
from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose
from companion.messages import (
    AttitudeSample,
    Frame,
    HeightSample,
    KeyframeAdded,
    MapUpdate,
    Message,
    Odometry,
    PositionSample,
    RangeSample,
    Track,
    TrackState,
    Warned,
)
from companion.slam.loop.loop_closure import LoopClosure
from companion.slam.map.map_part import map_of, part_around
from companion.slam.map.sparse_map import Keyframe, SlamMap
from companion.slam.tracking.tracker import Prior, Tracker
from companion.timing.clock import Timer

MIN_COAST_NS = 150_000_000
MAX_COAST_NS, MAX_COAST_UNTOLD_NS = 4_000_000_000, 400_000_000
"""A pose is carried on for so long where nothing is recognised, with and without attitude."""
SIGMA_COASTING_RAD_S = np.radians(0.2)
REMEMBERED_NS = 600_000_000_000
"""What telemetry told longer ago is only asked for at the times of keyframes."""
LET_GO_EVERY_NS = 60_000_000_000
TAKEN_UP = "map resumed after restart"
NOT_TAKEN_UP = "old map not recognised: new map"


class LocalisationStage:
    """Knows where the camera is.

    With `beside` keyframes are worked into the map in another thread, so that no frame waits for
    it. What an autopilot thinks of its place is left aside where it flies on ours.
    """

    def __init__(
        self, config: Config, camera: Camera, times: Timer, *, background: bool = False
    ) -> None:
        self._config = config
        self._camera = camera
        self._times = times
        self._tracker = Tracker(config, camera, times, background)
        self._attitude = CameraAttitude(camera.body_from_camera)
        self._motion = MotionFilter()
        self._georeferencer = Georeferencer(
            config.georeference, camera.body_from_camera, sensors_only=config.feedback.mode != "off"
        )
        self._odometry = SmoothOdometry(camera, config.feedback.max_jump_m)
        self._places = SegmentPlaces(self._georeferencer, self._attitude, camera.body_from_camera)
        self._last: Track | None = None
        """The last frame with a pose, in the newest segment's own frame."""
        self._t_ns = 0
        self._let_go_ns: int | None = None
        self._resumption: Resumption | None = None
        """While a map from before is in question."""
        self._tracker.atlas.loop_allowed = self._allowed
        self._tracker.atlas.displacements_of = self._places.displacements_of

    @property
    def state(self) -> TrackState:
        """What the tracker knows."""
        return self._tracker.state

    @property
    def n_segments(self) -> int:
        """Maps that stand for themselves."""
        return len(self._segments())

    @property
    def n_loops(self) -> int:
        """Places that were known again and tied together."""
        return self._tracker.atlas.n_loops

    @property
    def camera_from_body(self) -> Pose:
        """Where the body is from the camera; the identity where that is not known."""
        mount = self._camera.body_from_camera
        return mount.inverse() if mount is not None else Pose.identity()

    def step(self, message: Message) -> Iterable[Message]:
        """Take one message; messages come in order of time.

        What a frame gives is worked out as it is asked for, the pose first: take all of it.
        """
        if isinstance(message, Frame):
            return self._frame(message)
        if isinstance(message, AttitudeSample):
            self._attitude.add(message)
        elif isinstance(message, (PositionSample, RangeSample, HeightSample)):
            self._georeferencer.take(message)
        return []

    def set_effort(self, share: float) -> None:
        """Look for this share of the features from now on, where time is short."""
        self._tracker.set_feature_ratio(share)

    def checkpoint(self) -> Checkpoint | None:
        """What another process needs to go on from the last frame; None unless it was tracked.

        It does not change with the map. A map from before that is in question gives none, nor does
        one with a scale while attitude is missing, by which whoever takes it up checks it.
        """
        last, segment = self._last, self._tracker.map
        if self._resumption is not None or last is None or last.map_from_camera is None:
            return None
        if last.t_ns != self._t_ns or self.state is not TrackState.TRACKING:
            return None
        told, georeference = self._attitude.at(last.t_ns), self._places.of(segment)
        mounted = self._camera.body_from_camera is not None
        if georeference is not None and mounted and told is None:
            return None
        with self._times("checkpoint"), self._tracker.map_lock.tracking():
            place = last.map_from_camera.translation
            (nearest,) = segment.nearest(place, 1, set())
            part = part_around(segment, segment.keyframes[nearest], MOST_BYTES)
        mount, late_ns = self._attitude.correction
        return Checkpoint(
            last.t_ns, part, self._tracker.next_keyframe_id,
            None if told is None else told @ last.map_from_camera.rotation.T, georeference,
            self._odometry.kept if georeference is not None else None, mount, late_ns,
        )  # fmt: skip

    def take_up(self, kept: Checkpoint, t_ns: int, absent_ns: int) -> None:
        """Begin with a map from before, if what is seen agrees; before the first frame, of `t_ns`.

        Its scale and place count once several frames have agreed with it. The last frame before
        was `absent_ns` ago.
        """
        shift_ns = t_ns - absent_ns - kept.t_ns  # clocks of two processes may differ
        features = self._config.features
        segment = map_of(kept.part, features.scale_factor, features.n_levels, shift_ns)
        self._resumption = Resumption(kept, t_ns, absent_ns)
        told = {k.keyframe_id: k.ned_from_camera for k in kept.part.keyframes}
        self._attitude.take_up(kept.body_from_camera, kept.late_ns, told)
        self._tracker.resume(segment, kept.next_keyframe_id, self._resumption.until_ns)

    def finish(self, adjust: bool = True) -> list[Message]:
        """Give the map as it is at the end of a flight, all of it adjusted once more or not."""
        out: list[Message] = [*self._tracker.close()]
        with self._times("final adjustment"):
            for segment in self._segments() if adjust else ():
                self._tracker.atlas.mapper_of(segment).adjust_all(
                    self._config.mapping.final_iterations
                )
        if self._segments():
            out.append(self._places.update(self._segments(), self._t_ns, final=True))
        return out

    def _segments(self) -> list[SlamMap]:
        return [s for s in self._tracker.segments if s.keyframes]

    def _frame(self, frame: Frame) -> Iterator[Message]:
        self._t_ns = frame.t_ns
        attitude = self._attitude.at(frame.t_ns)
        with (
            self._tracker.map_lock.tracking()
        ):  # all of it: beside mapping each would slow the other
            self._follow_map()
            predicted = self._predicted(frame.t_ns, attitude)
            before = self._tracker.map
            tied = predicted is not None and attitude is not None and self._motion.tied
            in_map = predicted.rotation if predicted is not None and tied else None
            tracked = self._tracker.step(frame, Prior(predicted, attitude, in_map))
        other_map = self._tracker.map is not before
        if other_map or self.state is TrackState.INITIALISING:
            self._forget_frames()
        # where another map lies must be known before the first pose in it is told
        update = self._map_update() if other_map and self._segments() else None
        for message in tracked:
            if isinstance(message, Track) and message.map_from_camera is not None:
                told = self._attitude.at(message.t_ns)
                if message.seq == frame.seq or told is not None:
                    # untold turns would be carried on, and those of a start are rough
                    self._motion.correct(message.t_ns, message.map_from_camera, told)
                self._attitude.compare(message, message.map_from_camera.rotation)
                if message.seq == frame.seq:
                    self._last = message
                    yield self._odometry_of(message)
                placed = self._places.main_from_newest.apply_to_pose(message.map_from_camera)
                yield replace(message, map_from_camera=placed)
            elif isinstance(message, Track):
                coasting = self._coasting(message, predicted)
                yield self._odometry_of(coasting or message)
                yield message if coasting is None else replace(coasting, map_from_camera=None)
            else:
                yield message
        added = any(isinstance(m, KeyframeAdded) for m in tracked)
        if update is None and added and self._segments():
            update = self._map_update()
        if update is not None:
            yield update
        if self._resumption is not None:
            yield from self._judge_map(self._resumption, frame.t_ns)
        yield from self._judge_attitude(frame.t_ns)
        self._let_go(frame.t_ns)

    def _let_go(self, t_ns: int) -> None:
        """Now and then forget telemetry that nothing will ask for: a flight may last for hours."""
        if self._let_go_ns is not None and t_ns < self._let_go_ns + LET_GO_EVERY_NS:
            return
        self._let_go_ns = t_ns
        with self._tracker.map_lock.tracking():
            living = {k.keyframe_id: k.t_ns for s in self._segments() for k in s.keyframes.values()}
        self._attitude.let_go(living.keys())
        when_ns: Array = np.array(sorted(living.values()))
        self._georeferencer.let_go(t_ns - REMEMBERED_NS, when_ns)

    def _judge_map(self, resumption: Resumption, t_ns: int) -> Iterator[MapUpdate | Warned]:
        """See whether the map from before is what is seen, and take it up or leave it."""
        last = self._last if self._last is not None and self._last.t_ns == t_ns else None
        kept, segment = resumption.kept, self._tracker.map
        in_use = segment.first_keyframe_id == kept.part.first_keyframe_id
        verdict = Verdict.REFUSED
        if in_use:
            attitude = self._attitude.at(t_ns)
            verdict = resumption.judge(t_ns, last, attitude, self.camera_from_body)
        if verdict is Verdict.TRYING:
            return
        self._resumption = None
        if verdict is Verdict.REFUSED:
            with self._tracker.map_lock.tracking():
                self._tracker.drop_map(kept.part.first_keyframe_id)
            if in_use:
                self._forget_frames()
            yield Warned(t_ns, NOT_TAKEN_UP, resumption.why_not)
            return
        if kept.georeference is not None:
            self._places.take_up(segment, kept.georeference)
            if kept.odometry is not None:
                self._odometry.take_up(segment.first_keyframe_id, kept.georeference, kept.odometry)
        away_s = resumption.absent_ns * 1e-9
        yield Warned(t_ns, TAKEN_UP, f"its last frame was {away_s:.1f} s before the first", True)
        yield self._map_update()

    def _forget_frames(self) -> None:
        """Another map is in use: where the last frames were is not of it."""
        self._motion.reset()
        self._attitude.forget()
        self._last = None

    def _map_update(self) -> MapUpdate:
        with self._times("georeference"), self._tracker.map_lock.tracking():
            return self._places.update(self._segments(), self._t_ns, final=False)

    def _follow_map(self) -> None:
        """Go on from where the last frame is in the map as it now is."""
        last, segment = self._last, self._tracker.map
        if last is None or last.keyframe_id is None or last.map_from_camera is None:
            return
        camera_from_map = segment.pose_of(last.keyframe_id)
        relative = last.keyframe_from_camera
        if camera_from_map is None or relative is None:
            return
        unit = segment.unit_of.get(last.keyframe_id, 1.0)
        inside = Pose(relative.rotation, unit * relative.translation)
        now = camera_from_map.inverse() @ inside
        if np.array_equal(now.translation, last.map_from_camera.translation):
            return
        self._motion.map_moved(last.map_from_camera, now)
        self._odometry.map_moved(now)
        self._last = replace(last, map_from_camera=now)

    def _predicted(self, t_ns: int, attitude: Array | None) -> Pose | None:
        """Where the camera should be in the newest segment; None when nothing is known.

        From one frame to the next motion goes on as it was; over a longer time the autopilot's
        velocity knows better.
        """
        predicted, last = self._motion.predict(t_ns, attitude), self._last
        if predicted is None or last is None or last.map_from_camera is None:
            return predicted
        placed = self._places.of(self._tracker.map)
        if placed is None or t_ns - last.t_ns < MIN_COAST_NS:
            return predicted
        moved_m = self._georeferencer.moved(last.t_ns, t_ns)
        if moved_m is None:
            return predicted
        to_map = placed.world_from_map.inverse()
        moved = to_map.scale * to_map.rotation @ moved_m
        return Pose(predicted.rotation, last.map_from_camera.translation + moved)

    def _coasting(self, track: Track, predicted: Pose | None) -> Track | None:
        """A lost frame whose pose is carried on; None where it is not known well enough."""
        placed = self._places.of(self._tracker.map)
        last = self._last
        if track.state is not TrackState.LOST or None in (predicted, placed, last):
            return None
        assert last is not None
        assert placed is not None
        blind_ns = track.t_ns - last.t_ns
        told = self._attitude.at(track.t_ns) is not None
        if blind_ns > (MAX_COAST_NS if told else MAX_COAST_UNTOLD_NS):
            return None
        sigma_m = SIGMA_COASTING_M_S * blind_ns * 1e-9
        return replace(
            track, state=TrackState.COASTING, map_from_camera=predicted,
            sigma_position=last.sigma_position + sigma_m / placed.world_from_map.scale,
            sigma_rotation_rad=last.sigma_rotation_rad + SIGMA_COASTING_RAD_S * blind_ns * 1e-9,
        )  # fmt: skip

    def _odometry_of(self, track: Track) -> Odometry:
        """A track of the newest segment, in that segment's own frame, as an autopilot wants it."""
        segment = self._tracker.map
        return self._odometry.step(
            track, segment.first_keyframe_id, self._places.of(segment), self._motion.velocity
        )

    def _judge_attitude(self, t_ns: int) -> list[Warned]:
        if not self._attitude.due(t_ns):
            return []
        segment = self._tracker.map
        placed = self._places.of(segment)

        def rotation_of(keyframe_id: int) -> Array | None:
            pose = segment.pose_of(keyframe_id)
            return None if pose is None else pose.rotation.T

        with self._tracker.map_lock.tracking():
            judged = self._attitude.judge(
                t_ns, rotation_of, None if placed is None else placed.world_from_map.rotation
            )
        if judged.now_from_before is not None:
            self._turn_attitudes(judged.now_from_before)
        if judged.before_from_now_ned is not None:
            self._motion.attitude_corrected(judged.before_from_now_ned)
        if judged.disowned_since_ns is not None:
            self._disown_attitudes(judged.disowned_since_ns)
        if judged.reinitialise:
            with self._tracker.map_lock.tracking():
                self._tracker.reinitialise(judged.n_anew, keep=not judged.young)
            self._motion.reset()
            self._attitude.forget()
            self._last = None
        return judged.warnings

    def _disown_attitudes(self, since_ns: int) -> None:
        """Keyframes since then were given attitudes that are not the camera's."""
        self._motion.untie()
        with self._tracker.map_lock.tracking():
            for segment in self._tracker.segments:
                for keyframe in segment.keyframes.values():
                    if keyframe.t_ns >= since_ns:
                        keyframe.ned_from_camera = None

    def _turn_attitudes(self, turn: Array) -> None:
        """What keyframes were told of their attitude was told by the mount as it was stated."""
        with self._tracker.map_lock.tracking():
            for segment in self._tracker.segments:
                for keyframe in segment.keyframes.values():
                    if keyframe.ned_from_camera is not None:
                        keyframe.ned_from_camera = keyframe.ned_from_camera @ turn.T

    def _allowed(self, keyframe: Keyframe, other: Keyframe, found: LoopClosure) -> bool:
        return self._places.allowed(self._tracker.map, keyframe, other, found)
