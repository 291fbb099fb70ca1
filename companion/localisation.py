"""The localisation stage: frames and telemetry in; tracks, keyframes and the map out.

It joins what must know each other in flight: the autopilot's attitude predicts the tracker's next
pose, the tracker's keyframes tell where the map lies in the world.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from companion.camera import Camera
from companion.clock import Timer
from companion.config import Config
from companion.geometry import Array, Pose, Similarity, angle_between, rotation_from_vector
from companion.georeference import Georeferencer, Place
from companion.messages import (
    AttitudeSample,
    Frame,
    Georeference,
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
from companion.motion import AttitudeHistory, MotionFilter
from companion.mount import RATE_STEP_NS, MountEstimate, MountEstimator
from companion.odometry import SIGMA_COASTING_M_S, SmoothOdometry
from companion.slam.map import Keyframe, SlamMap
from companion.slam.reunion import Reunion
from companion.slam.tracker import Prior, Tracker

MAX_DISAGREEMENT_RAD = np.radians(4.0)
"""An attitude that misses this much of the camera's turning between frames is not the camera's."""
MOUNT_EVERY_NS = 3_000_000_000
MIN_MOUNT_RAD, MIN_LATE_S = np.radians(0.3), 0.006
"""Corrections of mount and clock that are not worth making."""
TOLD_DEG, TOLD_S = 1.5, 0.025
"""Corrections that somebody should know of."""
MIN_COAST_NS = 150_000_000
MAX_COAST_NS, MAX_COAST_UNTOLD_NS = 4_000_000_000, 400_000_000
"""A pose is carried on for so long where nothing is recognised, with and without attitude."""
SIGMA_COASTING_RAD_S = np.radians(0.2)
MAX_REUNION_OFF_M = 6.0
"""What the autopilot's own positions may be wrong by between two times."""
MIN_DOWN_COSINE = np.cos(np.radians(8.0))


class LocalisationStage:
    """Knows where the camera is.

    With `beside` keyframes are worked into the map in another thread, so that no frame waits for
    it. What an autopilot thinks of its place is left aside where it flies on ours.
    """

    def __init__(
        self, config: Config, camera: Camera, times: Timer, *, beside: bool = False
    ) -> None:
        self._config = config
        self._camera = camera
        self._times = times
        self._tracker = Tracker(config, camera, times, beside)
        self._attitude = AttitudeHistory()
        self._motion = MotionFilter()
        self._georeferencer = Georeferencer(
            config.georeference, camera.body_from_camera, sensors_only=config.feedback.mode != "off"
        )
        self._odometry = SmoothOdometry(camera, config.feedback.max_jump_m)
        self._georeferences: dict[int, Georeference] = {}
        mount = camera.body_from_camera
        self._use_attitude = mount is not None
        self._mount_rotation = mount.rotation if mount is not None else np.eye(3)
        self._late_ns = 0
        """What the autopilot's stamps were found to be late by."""
        self._mounting = MountEstimator(self._mount_rotation)
        self._mount_told = False
        self._mount_due_ns = 0
        self._main_from_newest = Similarity.identity()
        self._attitudes: dict[int, tuple[Array, Array] | None] = {}
        """`ned_from_body` and body rates of keyframes, kept when the history has moved on"""
        self._revision = 0
        self._last: Track | None = None
        """The last frame with a pose, in the newest segment's own frame."""
        self._t_ns = 0
        self._tracker.atlas.allowed = self._allowed

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
        self._tracker.set_effort(share)

    def finish(self, adjust: bool = True) -> list[Message]:
        """Give the map as it is at the end of a flight, all of it adjusted once more or not."""
        out: list[Message] = [*self._tracker.close()]
        with self._times("final adjustment"):
            for segment in self._segments() if adjust else ():
                self._tracker.atlas.mapper_of(segment).adjust_all(
                    self._config.mapping.final_iterations
                )
        if self._segments():
            out.append(self._map_update(final=True))
        return out

    def _segments(self) -> list[SlamMap]:
        return [s for s in self._tracker.segments if s.keyframes]

    def _ned_from_camera(self, t_ns: int) -> Array | None:
        mount = self._camera.body_from_camera
        if not self._use_attitude or mount is None:
            return None
        attitude = self._attitude.at(t_ns + self._late_ns)
        return None if attitude is None else attitude @ self._mount_rotation

    def _frame(self, frame: Frame) -> Iterator[Message]:
        self._t_ns = frame.t_ns
        attitude = self._ned_from_camera(frame.t_ns)
        with self._tracker.turn.tracking():  # all of it: beside mapping each would slow the other
            self._follow_map()
            predicted = self._predicted(frame.t_ns, attitude)
            before = self._tracker.map
            tied = predicted is not None and attitude is not None and self._motion.tied
            in_map = predicted.rotation if predicted is not None and tied else None
            tracked = self._tracker.step(frame, Prior(predicted, attitude, in_map))
        if self._tracker.map is not before or self.state is TrackState.INITIALISING:
            self._motion.reset()
            self._mounting.forget()
            self._last = None
        for message in tracked:
            if isinstance(message, Track) and message.map_from_camera is not None:
                if message.seq == frame.seq:
                    self._last = message
                    self._motion.correct(frame.t_ns, message.map_from_camera, attitude)
                    if self._use_attitude:
                        self._mounting.take(
                            frame.t_ns, message.map_from_camera.rotation, self._attitude
                        )
                    yield self._odometry_of(message)
                placed = self._main_from_newest.apply_to_pose(message.map_from_camera)
                yield replace(message, map_from_camera=placed)
            elif isinstance(message, Track):
                coasting = self._coasting(message, predicted)
                yield self._odometry_of(coasting or message)
                yield message if coasting is None else replace(coasting, map_from_camera=None)
            else:
                yield message
        if any(isinstance(m, KeyframeAdded) for m in tracked):
            with self._times("georeference"), self._tracker.turn.tracking():
                update = self._map_update(final=False)
            yield update
        yield from self._judge_attitude(frame.t_ns)

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
        placed = self._georeferences.get(self._tracker.map.first_keyframe_id)
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
        placed = self._georeferences.get(self._tracker.map.first_keyframe_id)
        last = self._last
        if track.state is not TrackState.LOST or None in (predicted, placed, last):
            return None
        assert last is not None
        assert placed is not None
        blind_ns = track.t_ns - last.t_ns
        told = self._ned_from_camera(track.t_ns) is not None
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
        key = self._tracker.map.first_keyframe_id
        return self._odometry.step(
            track, key, self._georeferences.get(key), self._motion.velocity
        )  # fmt: skip

    def _judge_attitude(self, t_ns: int) -> list[Message]:
        """See how far the attitude is the camera's: correct it, or stop using it (a gimbal)."""
        if not self._use_attitude:
            return []
        disagreement = self._motion.attitude_disagreement_rad
        if disagreement is not None and disagreement > MAX_DISAGREEMENT_RAD:
            return self._drop_attitude(t_ns, disagreement)
        if t_ns < self._mount_due_ns:
            return []
        self._mount_due_ns = t_ns + MOUNT_EVERY_NS
        found = self._mounting.estimate()
        if found is None:
            return []
        if found.useless:
            return self._drop_attitude(t_ns, found.residual_rad)
        return self._correct_mount(t_ns, found) if found.certain else []

    def _drop_attitude(self, t_ns: int, off_rad: float) -> list[Message]:
        self._use_attitude = False
        detail = f"turns differ by {np.degrees(off_rad):.1f} degrees; is there a gimbal?"
        return [
            Warned(t_ns, "the autopilot's attitude is not the camera's and is not used", detail)
        ]

    def _correct_mount(self, t_ns: int, found: MountEstimate) -> list[Message]:
        """Use the mount and the clock as they were found to be; say so where they are far off."""
        off_rad = angle_between(self._mount_rotation, found.body_from_camera)
        off_s = abs(found.offset_s - self._late_ns * 1e-9)
        sigma_rad = float(np.linalg.norm(found.sigma_turn_rad))
        if off_rad < max(sigma_rad, MIN_MOUNT_RAD) and off_s < max(
            2.0 * found.sigma_offset_s, MIN_LATE_S
        ):
            return []
        before = self._ned_from_camera(t_ns)
        self._turn_downs(found.body_from_camera.T @ self._mount_rotation)
        self._mount_rotation = found.body_from_camera
        self._late_ns = int(found.offset_s * 1e9)
        after = self._ned_from_camera(t_ns)
        if before is not None and after is not None:
            self._motion.attitude_corrected(before @ after.T)
        turn = np.degrees(found.turn_camera_rad)
        if self._mount_told or (
            float(np.linalg.norm(turn)) < TOLD_DEG and abs(found.offset_s) < TOLD_S
        ):
            return []
        self._mount_told = True
        about = " ".join(f"{v:+.1f}" for v in turn)
        detail = (
            f"the camera is turned by {about} degrees about its right, down and forward axes, "
            f"telemetry is {found.offset_s * 1e3:+.0f} ms late; put that into the calibration"
        )
        return [Warned(t_ns, "camera and autopilot were found to disagree, corrected", detail)]

    def _turn_downs(self, turn: Array) -> None:
        """What keyframes were told of the vertical was told by the mount as it was stated."""
        with self._tracker.turn.tracking():
            for segment in self._tracker.segments:
                for keyframe in segment.keyframes.values():
                    if keyframe.down_camera is not None:
                        keyframe.down_camera = turn @ keyframe.down_camera

    def _map_update(self, final: bool) -> MapUpdate:
        """The map, all segments in the frame of the main one (the one with most keyframes)."""
        self._revision += 1
        segments = self._segments()
        for segment in segments:
            newest = segment is segments[-1]
            if final or (newest and self._due(segment)):
                found = self._georeferencer.solve([self._place(k) for k in _spread(segment, final)])
                key = segment.first_keyframe_id
                if found is not None:
                    self._georeferences[key] = found
        main = max(segments, key=lambda s: len(s.keyframes))
        main_key = main.first_keyframe_id
        anchor = self._georeferences.get(main_key)
        poses: dict[int, Pose] = {}
        scales: dict[int, float] = {}
        points: list[Array] = []
        n_retired = 0
        for segment in segments:
            own = self._georeferences.get(segment.first_keyframe_id)
            if segment is main:
                main_from_own = Similarity.identity()
            elif anchor is not None and own is not None:
                main_from_own = anchor.world_from_map.inverse() @ own.world_from_map
            else:
                continue  # nothing says how this segment lies to the main one
            if segment is segments[-1]:
                self._main_from_newest = main_from_own
            n_retired += len(segment.retired)
            for key, map_from_camera in segment.places():
                poses[key] = main_from_own.apply_to_pose(map_from_camera)
                unit = main_from_own.scale * segment.unit_of.get(key, 1.0)
                if unit != 1.0:
                    scales[key] = unit
            points.append(main_from_own.apply(segment.living_positions()))
        return MapUpdate(
            self._revision, self._t_ns, poses, np.concatenate(points), anchor, scales, n_retired,
        )  # fmt: skip

    def _allowed(self, keyframe: Keyframe, other: Keyframe, found: Reunion) -> bool:
        """Whether the autopilot can have been where a reunion would have it been."""
        here = self._tracker.map if keyframe.keyframe_id in self._tracker.map.keyframes else None
        placed = None if here is None else self._georeferences.get(here.first_keyframe_id)
        if placed is None:
            return True
        way = found.here_from_there.apply(other.centre) - keyframe.centre
        way_m = placed.world_from_map.scale * placed.world_from_map.rotation @ way
        flown_m = self._georeferencer.way_between(keyframe.t_ns, other.t_ns)
        if flown_m is None:
            return True
        off_m = float(np.linalg.norm(way_m - flown_m))
        return off_m < MAX_REUNION_OFF_M + 3.0 * placed.sigma_scale * float(np.linalg.norm(way_m))

    def _due(self, segment: SlamMap) -> bool:
        n = len(segment.keyframes)
        return n < 40 or n % 5 == 0

    def _place(self, keyframe: Keyframe) -> Place:
        return Place(
            keyframe.t_ns,
            keyframe.camera_from_map.inverse(),
            self._attitude_of(keyframe) if self._use_attitude else None,
            self._ground_below(keyframe),
        )

    def _attitude_of(self, keyframe: Keyframe) -> Array | None:
        """A keyframe's attitude, interpolated once samples from after it have come."""
        key, t_ns = keyframe.keyframe_id, keyframe.t_ns
        if key not in self._attitudes:
            if self._attitude.newest_t_ns < t_ns + RATE_STEP_NS:
                return self._ned_from_camera(t_ns)
            self._attitudes[key] = self._attitude.with_rates_at(t_ns, RATE_STEP_NS)
        kept = self._attitudes[key]
        if kept is None:
            return None
        attitude, rates = kept
        return (
            attitude @ rotation_from_vector(rates * (self._late_ns * 1e-9)) @ self._mount_rotation
        )

    def _ground_below(self, keyframe: Keyframe) -> float | None:
        """Distance from the camera down the body's axis to the map, in map units."""
        mount = self._camera.body_from_camera
        if mount is None:
            return None
        segment = next(s for s in self._segments() if keyframe.keyframe_id in s.keyframes)
        _, ids = segment.seen_by(keyframe)
        p = keyframe.camera_from_map.apply(segment.positions[ids]) @ mount.rotation.T
        distance = np.linalg.norm(p, axis=1)
        below = p[p[:, 2] > MIN_DOWN_COSINE * distance]
        return float(np.median(below[:, 2])) if len(below) >= 5 else None


def _spread(segment: SlamMap, final: bool) -> list[Keyframe]:
    keyframes = list(segment.keyframes.values())
    most = 400 if final else 120
    if len(keyframes) <= most:
        return keyframes
    return [keyframes[int(i)] for i in np.linspace(0, len(keyframes) - 1, most).astype(int)]
