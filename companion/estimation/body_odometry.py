"""Odometry of the body by the active map: what map, attitude and gimbal tell of it is put in."""

from __future__ import annotations

from dataclasses import replace

from companion.estimation.attitude.camera_attitude import CameraAttitude
from companion.estimation.body.body_filter import BodyFilter
from companion.estimation.body.body_state import Reckoned
from companion.estimation.body.reckoning import BodyAttitude
from companion.estimation.camera_motion import CameraMotion
from companion.estimation.georeference.georeferencer import Georeferencer
from companion.estimation.georeference.segment_georeference import SegmentGeoreferences
from companion.estimation.gimbal.gimbal_head import GimbalHead
from companion.estimation.odometry.odometry_frame import MapView
from companion.estimation.odometry.smooth_odometry import SmoothOdometry
from companion.geometry.transforms import Array, Pose
from companion.messages import Odometry, Track
from companion.slam.tracking.tracker import Tracker


class BodyOdometry:
    """Steps the smooth odometry by the frames of the active map, and predicts the camera's pose."""

    def __init__(
        self, tracker: Tracker, attitude: CameraAttitude, gimbal: GimbalHead | None,
        motion: CameraMotion, georeferencer: Georeferencer, georeferences: SegmentGeoreferences,
        body: BodyFilter, smooth: SmoothOdometry,
    ) -> None:  # fmt: skip
        self._tracker, self._attitude, self._gimbal = tracker, attitude, gimbal
        self._motion = motion
        self._georeferencer, self._georeferences = georeferencer, georeferences
        self._body, self._smooth = body, smooth

    def begin(self, t_ns: int, stands: bool) -> Reckoned | None:
        """Go on to the next frame; see `SmoothOdometry.begin`."""
        stands_at = self._georeferencer.path.newest_place if stands else None
        return self._smooth.begin(t_ns, self._body_attitude(t_ns), stands, stands_at)

    def apply_map_correction(self) -> None:
        """Move the motion state with corrections of the map."""
        segment = self._tracker.map
        moved = self._motion.follow(segment)
        if moved is not None:
            self._smooth.correct_map(segment.first_keyframe_id, *moved)

    def predicted(
        self, t_ns: int, attitude: Array | None, reckoned: Reckoned | None
    ) -> Pose | None:
        """Predicted pose in the active segment; None when unknown."""

        def place_of(rotation: Array) -> Array | None:
            assert reckoned is not None
            return self._smooth.place_in_map(reckoned.place_m, rotation)

        return self._motion.predicted(
            t_ns, attitude, self._georeferences.of(self._tracker.map),
            None if reckoned is None else place_of,
            self._georeferencer.path.displacement_by_velocity,
        )  # fmt: skip

    def of_track(self, track: Track) -> Odometry:
        """Odometry of a track of the active segment, in its own frame."""
        segment = self._tracker.map
        first = segment.keyframes.get(segment.first_keyframe_id)
        view = self._tracker.view_of(track.seq)
        seen = None if view is None else view.point_ids[view.point_ids >= 0]
        odometry = self._smooth.step(
            track, segment.first_keyframe_id, self._georeferences.of(segment),
            self._motion.velocity,
            None if first is None else MapView(first.t_ns, first.camera_from_map.inverse()),
            None if seen is None else segment.born[seen],
        )  # fmt: skip
        return self._given(odometry)

    def without_frame(self, seq: int, t_ns: int) -> Odometry | None:
        """Odometry by inertial navigation alone; None where that knows none."""
        found = self._smooth.without_frame(seq, t_ns, self._body_attitude(t_ns))
        return None if found is None else self._given(found)

    def _given(self, odometry: Odometry) -> Odometry:
        """Odometry as it is given out: of the body."""
        odometry = replace(odometry, refused=self._body.n_refused)
        if self._gimbal is None:
            return odometry
        attitude = None if self._attitude.doubted else self._body_attitude(odometry.t_ns)
        return self._gimbal.body_of(odometry, None if attitude is None else attitude.ned_from_body)

    def _body_attitude(self, t_ns: int) -> BodyAttitude | None:
        """Attitude of the body at a frame, where the autopilot's is that of the camera.

        With a gimbal it is that of its head.
        """
        ned_from_camera = self._attitude.at(t_ns)
        if ned_from_camera is None:
            return None
        mount = self._attitude.correction[0]
        return BodyAttitude(t_ns + self._attitude.imu_delay_ns, ned_from_camera @ mount.T)
