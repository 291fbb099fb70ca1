"""Motion of the camera in the active map: its last pose there, and where it should be next."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from companion.estimation.motion_filter import MotionFilter
from companion.estimation.odometry.smooth_odometry import SIGMA_DEAD_RECKONING_M_S
from companion.geometry.transforms import Array, Pose
from companion.messages import Georeference, Track, TrackState
from companion.slam.map.sparse_map import SlamMap

MIN_DEAD_RECKONING_NS = 150_000_000
MAX_DEAD_RECKONING_NS, MAX_DEAD_RECKONING_NO_ATTITUDE_NS = 4_000_000_000, 400_000_000
"""Longest dead reckoning without tracking, with and without attitude."""
SIGMA_DEAD_RECKONING_RAD_S = np.radians(0.2)


class CameraMotion:
    """The motion filter of the active map, with the last track of which it knows."""

    def __init__(self) -> None:
        self.filter = MotionFilter()
        self.last: Track | None = None
        """The last frame with a pose, in the frame of the active map."""

    def reset(self) -> None:
        """Forget the motion, after another map became active."""
        self.filter.reset()
        self.last = None

    def predicted(
        self,
        t_ns: int,
        attitude: Array | None,
        placed: Georeference | None,
        reckoned: Callable[[Array], Array | None] | None,
        moved_m: Callable[[int, int], Array | None],
    ) -> Pose | None:
        """Predicted pose in the active map; None when unknown.

        Constant velocity between frames. Over longer spans inertial navigation, whose place (3,) of
        the camera in the map `reckoned` gives for its rotation (3, 3) there, else the way (3,) by
        the velocity of the autopilot between two times, `moved_m`, None where that is unknown.
        """
        predicted, last = self.filter.predict(t_ns, attitude), self.last
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
        moved = to_map.scale * to_map.rotation @ way_m
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
        self.filter.correct_map(last.map_from_camera, now)
        self.last = replace(last, map_from_camera=now)
        return last.t_ns, now
