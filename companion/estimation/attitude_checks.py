"""Checks of maps by the autopilot's attitude and IMU in flight, and what follows if one fails."""

from __future__ import annotations

from companion.estimation.attitude.camera_attitude import AttitudeCheck, CameraAttitude
from companion.estimation.attitude.keyframe_attitudes import clear_since, correct_mount
from companion.estimation.camera_motion import CameraMotion
from companion.estimation.georeference.segment_georeference import SegmentGeoreferences
from companion.estimation.odometry.smooth_odometry import SmoothOdometry
from companion.geometry.transforms import Array
from companion.messages import Warned
from companion.slam.tracking.tracker import Tracker

SIGHT_STANDS = "the picture stands while the vehicle moves: map begun anew"
MAX_STANDS_NS = 700_000_000
"""Shorter than what the filter of the body refuses until it believes the map: a second."""
NO_CLIMB = "at lift-off it sees another motion than the accelerometers measure; check mount.*"


class AttitudeChecks:
    """Applies to maps, motion and odometry what checks of the attitude find."""

    def __init__(
        self, attitude: CameraAttitude, tracker: Tracker, motion: CameraMotion,
        georeferences: SegmentGeoreferences, odometry: SmoothOdometry,
    ) -> None:  # fmt: skip
        self._attitude, self._tracker, self._motion = attitude, tracker, motion
        self._georeferences, self._odometry = georeferences, odometry

    def check(self, t_ns: int) -> list[Warned]:
        """Check the active map, by the attitude where that is due."""
        stands_ns = self._odometry.standing_picture.since_ns
        if stands_ns is not None and t_ns - stands_ns > MAX_STANDS_NS:
            self._leave_map(1, True, 0.0)
            return [Warned(t_ns, SIGHT_STANDS, "by the accelerometers; is the lens covered?")]
        if not self._attitude.due(t_ns):
            return []
        segment = self._tracker.map
        placed = self._georeferences.of(segment)

        def rotation_of(keyframe_id: int) -> Array | None:
            pose = segment.pose_of(keyframe_id)
            return None if pose is None else pose.rotation.T

        return self._apply(
            self._attitude.check(
                t_ns, rotation_of, None if placed is None else placed.world_from_map.rotation
            )
        )

    def contradicted_at_lift_off(self, t_ns: int) -> list[Warned]:
        """Take that images at a lift-off contradict the accelerometers."""
        return self._apply(self._attitude.contradicted(t_ns, NO_CLIMB))

    def _apply(self, checked: AttitudeCheck) -> list[Warned]:
        if checked.now_from_before is not None:
            correct_mount(self._tracker.segments, checked.now_from_before)
        if checked.before_from_now_ned is not None:
            self._motion.correct_attitude(checked.before_from_now_ned)
        if checked.invalid_since_ns is not None:
            self._motion.discard_alignment()
            clear_since(self._tracker.segments, checked.invalid_since_ns)
        if checked.reinitialise:
            self._leave_map(checked.n_reinitialised, not checked.young, checked.tilt_rad)
        return checked.warnings

    def _leave_map(self, number: int, keep: bool, tilt_rad: float) -> None:
        segment = self._tracker.map
        self._tracker.reinitialise(number, keep)
        self._motion.reset()
        self._attitude.reset()
        self._odometry.discard_map(segment.first_keyframe_id, tilt_rad)
