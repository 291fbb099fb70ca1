"""Motion of the camera in the active map: its last poses there, and where it should be next."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from companion.geometry.transforms import (
    Array,
    Pose,
    angle_between,
    interpolate_rotation,
    nearest_rotation,
    vector_from_rotation,
)
from companion.messages import Georeference, Track, TrackState
from companion.slam.map.sparse_map import SlamMap

MIN_DEAD_RECKONING_NS = 150_000_000
MAX_DEAD_RECKONING_NS, MAX_DEAD_RECKONING_NO_ATTITUDE_NS = 4_000_000_000, 400_000_000
"""Longest dead reckoning without tracking, with and without attitude."""
SIGMA_DEAD_RECKONING_RAD_S = np.radians(0.2)
SIGMA_DEAD_RECKONING_M_S = 0.3
"""Standard deviation of the velocity used in dead reckoning."""
MAX_EXTRAPOLATION_S = 1.0
"""Beyond, a held velocity says nothing."""
MAX_RATE_SPAN_NS = 300_000_000
"""Over longer spans a drone may turn this way and back."""
MAX_SPAN_NS = 2_000_000_000
"""Poses further apart say nothing of the motion."""
N_POSES = 4
"""A line through so many is no worse than a Kalman filter of constant velocity: on field_survey the
next place is off by 3.8 thousandths of the scene's distance at the 95th percentile either way, on
campus_orbit by 1.2; through two by 4.5 and 1.7."""


class ImageVelocity(NamedTuple):
    """Velocity (3,) of the camera by its last images, map units per second, and their span."""

    map_units_s: Array
    span_s: float


class CameraMotion:
    """The last poses in the active map, and the attitude's alignment with it.

    Between frames the camera goes on as it did. What is known of the motion beyond, in metres, is
    of the filter of the body: this is in the units of a map that may have no scale.
    """

    def __init__(self) -> None:
        self.last: Track | None = None
        """The last frame with a pose, in the frame of the active map."""
        self._poses: deque[tuple[int, Pose]] = deque(maxlen=N_POSES)
        """Times and `map_from_camera` of the last images, those of backfilled frames too."""
        self._map_from_ned: Array | None = None
        """Alignment by the last image with an attitude; None before the first."""

    def reset(self) -> None:
        """Forget the motion, after another map became active."""
        self.last, self._map_from_ned = None, None
        self._poses.clear()

    @property
    def aligned(self) -> bool:
        """True once the attitude predicts rotations in the map."""
        return self._map_from_ned is not None

    @property
    def velocity(self) -> ImageVelocity | None:
        """Velocity of late; None until known."""
        if len(self._poses) < 2:
            return None
        t_s = np.array([t_ns - self._poses[-1][0] for t_ns, _ in self._poses]) * 1e-9
        span_s = -float(t_s[0])
        t_s -= t_s.mean()
        places = np.stack([pose.translation for _, pose in self._poses])
        return ImageVelocity(np.asarray(t_s @ places / (t_s @ t_s)), span_s)

    @property
    def rates_camera_rad_s(self) -> Array | None:
        """Angular rate (3,) of the camera in its axes between the last two images.

        None where unknown.
        """
        if len(self._poses) < 2:
            return None
        (t0, a), (t1, b) = self._poses[-2], self._poses[-1]
        if t1 - t0 >= MAX_RATE_SPAN_NS:
            return None
        return vector_from_rotation(a.rotation.T @ b.rotation) / ((t1 - t0) * 1e-9)

    def correct(self, t_ns: int, map_from_camera: Pose, ned_from_camera: Array | None) -> None:
        """Take the pose of an image, with its attitude where that is known."""
        if self._poses and not 0 < t_ns - self._poses[-1][0] <= MAX_SPAN_NS:
            self._poses.clear()
        self._poses.append((t_ns, map_from_camera))
        if ned_from_camera is not None:
            self._map_from_ned = nearest_rotation(map_from_camera.rotation @ ned_from_camera.T)

    def correct_attitude(self, old_from_new: Array) -> None:
        """Apply a change of the attitude to the alignment."""
        if self._map_from_ned is not None:
            self._map_from_ned = nearest_rotation(self._map_from_ned @ old_from_new)

    def discard_alignment(self) -> None:
        """Invalidate the alignment: the attitude was not that of the camera."""
        self._map_from_ned = None

    def carried_on(self, t_ns: int, ned_from_camera: Array | None) -> Pose | None:
        """The pose if the camera goes on as of late; None when unknown.

        With an attitude its rotation is that.
        """
        if not self._poses:
            return None
        t1, b = self._poses[-1]
        dt_s, velocity, place = (t_ns - t1) * 1e-9, self.velocity, b.translation
        if velocity is not None:
            place = place + np.clip(dt_s, 0.0, MAX_EXTRAPOLATION_S) * velocity.map_units_s
        if ned_from_camera is not None and self._map_from_ned is not None:
            return Pose(self._map_from_ned @ ned_from_camera, place)
        if len(self._poses) < 2 or dt_s > MAX_EXTRAPOLATION_S:
            return Pose(b.rotation, place)
        t0, a = self._poses[-2]
        return Pose(interpolate_rotation(a.rotation, b.rotation, (t_ns - t0) / (t1 - t0)), place)

    def turn_apart(self, t_ns: int, ned_from_camera: Array) -> float:
        """Angle, rad, between the rotations at a frame by the attitude and by the last images.

        0 where either says nothing.
        """
        if not self._poses or t_ns - self._poses[-1][0] > MAX_RATE_SPAN_NS:
            return 0.0
        by_images = self.carried_on(t_ns, None)
        if by_images is None or self._map_from_ned is None:
            return 0.0
        return angle_between(by_images.rotation, self._map_from_ned @ ned_from_camera)

    def predicted(
        self,
        t_ns: int,
        attitude: Array | None,
        placed: Georeference | None,
        reckoned: Callable[[Array], Array | None] | None,
        moved_m: Callable[[int, int], Array | None],
    ) -> Pose | None:
        """Predicted pose in the active map; None when unknown.

        Constant velocity between frames. Over longer spans the filter of the body, whose place (3,)
        of the camera in the map `reckoned` gives for its rotation (3, 3) there, else the way (3,)
        by the velocity of the autopilot between two times, `moved_m`, None where that is unknown
        (an axis that is nan is taken as none: this says where to look for known points).
        """
        predicted, last = self.carried_on(t_ns, attitude), self.last
        if predicted is None or last is None or last.map_from_camera is None or placed is None:
            return predicted
        if t_ns - last.t_ns < MIN_DEAD_RECKONING_NS:
            return predicted
        if reckoned is not None:
            place = reckoned(predicted.rotation)
            return predicted if place is None else Pose(predicted.rotation, place)
        way_m = moved_m(last.t_ns, t_ns)
        if way_m is None:
            return predicted
        to_map = placed.world_from_map.inverse()
        moved = to_map.scale * to_map.rotation @ np.nan_to_num(way_m)
        return Pose(predicted.rotation, last.map_from_camera.translation + moved)

    def dead_reckoned(
        self, track: Track, predicted: Pose | None, placed: Georeference | None, attitude: bool
    ) -> Track | None:
        """Dead-reckoned track of a lost frame, with or without attitude; None if too uncertain."""
        last = self.last
        if track.state is not TrackState.LOST:
            return None
        if predicted is None or placed is None or last is None:
            return None
        lost_ns = track.t_ns - last.t_ns
        if lost_ns > (MAX_DEAD_RECKONING_NS if attitude else MAX_DEAD_RECKONING_NO_ATTITUDE_NS):
            return None
        sigma_m = SIGMA_DEAD_RECKONING_M_S * lost_ns * 1e-9
        return replace(
            track, state=TrackState.DEAD_RECKONING, map_from_camera=predicted,
            sigma_position=last.sigma_position + sigma_m / placed.world_from_map.scale,
            sigma_rotation_rad=last.sigma_rotation_rad
            + SIGMA_DEAD_RECKONING_RAD_S * lost_ns * 1e-9,
        )  # fmt: skip

    def follow(self, segment: SlamMap) -> tuple[int, Pose] | None:
        """Move with a correction of the map.

        Time of the last frame with a pose, and where it is now; None if unmoved.
        """
        last = self.last
        if last is None or last.keyframe_id is None or last.map_from_camera is None:
            return None
        camera_from_map = segment.pose_of(last.keyframe_id)
        relative = last.keyframe_from_camera
        if camera_from_map is None or relative is None:
            return None
        unit = segment.unit_of.get(last.keyframe_id, 1.0)
        inside = Pose(relative.rotation, unit * relative.translation)
        now = camera_from_map.inverse() @ inside
        if np.array_equal(now.translation, last.map_from_camera.translation):
            return None
        self._move(last.map_from_camera, now)
        self.last = replace(last, map_from_camera=now)
        return last.t_ns, now

    def _move(self, before: Pose, after: Pose) -> None:
        """Apply a correction of the map that moved a `map_from_camera`."""
        turn = nearest_rotation(after.rotation @ before.rotation.T)
        moved = [
            (t_ns, Pose(
                turn @ pose.rotation,
                after.translation + turn @ (pose.translation - before.translation),
            ))
            for t_ns, pose in self._poses
        ]  # fmt: skip
        self._poses = deque(moved, maxlen=N_POSES)
        if self._map_from_ned is not None:
            self._map_from_ned = nearest_rotation(turn @ self._map_from_ned)
