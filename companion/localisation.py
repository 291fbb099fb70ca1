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
from companion.geometry import Array, Pose, Similarity
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
from companion.odometry import SmoothOdometry
from companion.slam.map import Keyframe, SlamMap
from companion.slam.mapper import Mapper
from companion.slam.tracker import Prior, Tracker

MAX_DISAGREEMENT_RAD = np.radians(4.0)
"""An attitude that misses this much of the camera's turning between frames is not the camera's."""
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
        self._mapper_config = config.mapping
        self._attitude = AttitudeHistory()
        self._motion = MotionFilter()
        self._georeferencer = Georeferencer(
            config.georeference, camera.body_from_camera, sensors_only=config.feedback.mode != "off"
        )
        self._odometry = SmoothOdometry(camera, config.feedback.max_jump_m)
        self._georeferences: dict[int, Georeference] = {}
        self._use_attitude = camera.body_from_camera is not None
        self._main_from_newest = Similarity.identity()
        self._attitudes: dict[int, Array | None] = {}
        """`ned_from_camera` of keyframes, kept when the history has moved on"""
        self._revision = 0
        self._t_ns = 0

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
        return 0

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
                Mapper(
                    self._mapper_config, self._camera, segment, self._tracker.turn
                ).adjust_all(self._config.mapping.final_iterations)
        if self._segments():
            out.append(self._map_update(final=True))
        return out

    def _segments(self) -> list[SlamMap]:
        return [s for s in self._tracker.segments if s.keyframes]

    def _ned_from_camera(self, t_ns: int) -> Array | None:
        mount = self._camera.body_from_camera
        if not self._use_attitude or mount is None:
            return None
        attitude = self._attitude.at(t_ns)
        return None if attitude is None else attitude @ mount.rotation

    def _frame(self, frame: Frame) -> Iterator[Message]:
        self._t_ns = frame.t_ns
        attitude = self._ned_from_camera(frame.t_ns)
        predicted = self._motion.predict(frame.t_ns, attitude)
        n_segments = len(self._tracker.segments)
        tracked = self._tracker.step(frame, Prior(predicted, attitude))
        if len(self._tracker.segments) != n_segments or self.state is TrackState.INITIALISING:
            self._motion.reset()
        for message in tracked:
            if isinstance(message, Track) and message.map_from_camera is not None:
                if message.seq == frame.seq:
                    self._motion.correct(frame.t_ns, message.map_from_camera, attitude)
                    yield self._odometry_of(message)
                placed = self._main_from_newest.apply_to_pose(message.map_from_camera)
                yield replace(message, map_from_camera=placed)
            else:
                if isinstance(message, Track):
                    yield self._odometry_of(message)
                yield message
        if any(isinstance(m, KeyframeAdded) for m in tracked):
            with self._times("georeference"), self._tracker.turn.tracking():
                update = self._map_update(final=False)
            yield update
        yield from self._judge_attitude(frame.t_ns)

    def _odometry_of(self, track: Track) -> Odometry:
        """A track of the newest segment, in that segment's own frame, as an autopilot wants it."""
        key = self._tracker.map.first_keyframe_id
        return self._odometry.step(
            track, key, self._georeferences.get(key), self._motion.velocity
        )  # fmt: skip

    def _judge_attitude(self, t_ns: int) -> list[Message]:
        """Stop using an attitude that is not the camera's (a gimbal), and say so once."""
        disagreement = self._motion.attitude_disagreement_rad
        if not self._use_attitude or disagreement is None or disagreement < MAX_DISAGREEMENT_RAD:
            return []
        self._use_attitude = False
        degrees = float(np.degrees(disagreement))
        detail = f"turns between frames differ by {degrees:.1f} degrees; is there a gimbal?"
        return [
            Warned(t_ns, "the autopilot's attitude is not the camera's and is not used", detail)
        ]

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
            for key, keyframe in segment.keyframes.items():
                poses[key] = main_from_own.apply_to_pose(keyframe.camera_from_map.inverse())
                if main_from_own.scale != 1.0:
                    scales[key] = main_from_own.scale
            points.append(main_from_own.apply(segment.living_positions()))
        return MapUpdate(
            self._revision, self._t_ns, poses, np.concatenate(points), anchor, scales,
        )  # fmt: skip

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
        key = keyframe.keyframe_id
        if key not in self._attitudes:
            attitude = self._ned_from_camera(keyframe.t_ns)
            if self._attitude.newest_t_ns < keyframe.t_ns:
                return attitude
            self._attitudes[key] = attitude
        return self._attitudes[key]

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
