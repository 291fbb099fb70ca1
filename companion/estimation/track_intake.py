"""Tracks of localisation: what they tell of motion, attitude and scale, and their odometry."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from companion.estimation.attitude.camera_attitude import CameraAttitude
from companion.estimation.body_odometry import BodyOdometry
from companion.estimation.camera_motion import CameraMotion
from companion.estimation.georeference.segment_georeference import SegmentGeoreferences
from companion.estimation.gimbal.gimbal_head import GimbalHead
from companion.estimation.odometry.smooth_odometry import SmoothOdometry
from companion.geometry.transforms import Pose
from companion.messages import Message, Track, TrackState
from companion.slam.tracking.tracker import Tracker


class TrackIntake:
    """Takes the tracks of a frame: its own, and backfilled ones of earlier frames before it."""

    def __init__(
        self, tracker: Tracker, attitude: CameraAttitude, gimbal: GimbalHead | None,
        motion: CameraMotion, georeferences: SegmentGeoreferences, odometry: BodyOdometry,
        smooth: SmoothOdometry,
    ) -> None:  # fmt: skip
        self._tracker, self._attitude, self._gimbal = tracker, attitude, gimbal
        self._motion, self._georeferences = motion, georeferences
        self._odometry, self._smooth = odometry, smooth
        self.seen: Pose | None = None
        """`map_from_camera` of the newest frame, None while it is lost or stands."""

    def take(self, track: Track, is_now: bool, predicted: Pose | None) -> Iterator[Message]:
        """Outputs of a track, `is_now` if it is that of the frame; `predicted` was its pose."""
        if is_now:
            self.seen = None
        if self._smooth.standing_picture.since_ns is not None:
            yield self._odometry.of_track(track)
            yield Track(track.seq, track.t_ns, TrackState.LOST)
        elif track.map_from_camera is not None:
            yield from self._placed(track, track.map_from_camera, is_now)
        else:
            dead_reckoned = self._motion.dead_reckoned(
                track, predicted, self._georeferences.of(self._tracker.map),
                self._attitude.at(track.t_ns) is not None,
            )  # fmt: skip
            yield self._odometry.of_track(dead_reckoned or track)
            yield track if dead_reckoned is None else replace(dead_reckoned, map_from_camera=None)

    def _placed(self, track: Track, pose: Pose, is_now: bool) -> Iterator[Message]:
        measured = self._attitude.at(track.t_ns)
        if is_now or measured is not None:
            # angular rates are held without attitude; those of backfilled frames are rough
            self._motion.correct(track.t_ns, pose, measured)
        corrected_rad = 0.0 if self._gimbal is None else self._gimbal.corrected_rad
        self._attitude.compare(track, pose.rotation, corrected_rad)
        view, slam_map = self._tracker.view_of(track.seq), self._tracker.map
        if view is not None and track.keyframe_id is not None:
            self._georeferences.depths.compare(view, slam_map, track.keyframe_id)
        if is_now:
            self.seen = pose
            self._motion.last = track
            yield self._odometry.of_track(track)
        if not is_now or self._smooth.found_again.certain:
            mount = self._attitude.correction[0]
            self._georeferences.take(track, None if measured is None else measured @ mount.T)
        in_main = self._georeferences.main_from_newest.apply_to_pose(pose)
        yield replace(track, map_from_camera=in_main)
