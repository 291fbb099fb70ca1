"""Checks of the autopilot's attitude in flight, and what follows from one that fails."""

from __future__ import annotations

from companion.estimation.attitude.camera_attitude import AttitudeCheck, CameraAttitude
from companion.estimation.attitude.keyframe_attitudes import clear_since, correct_mount
from companion.estimation.camera_motion import CameraMotion
from companion.estimation.georeference.segment_georeference import SegmentGeoreferences
from companion.estimation.odometry.smooth_odometry import SmoothOdometry
from companion.geometry.transforms import Array
from companion.messages import Warned
from companion.slam.tracking.tracker import Tracker

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
        """Check it in the active map, where that is due."""
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
        segment = self._tracker.map
        if checked.now_from_before is not None:
            correct_mount(self._tracker.segments, checked.now_from_before)
        if checked.before_from_now_ned is not None:
            self._motion.correct_attitude(checked.before_from_now_ned)
        if checked.invalid_since_ns is not None:
            self._motion.discard_alignment()
            clear_since(self._tracker.segments, checked.invalid_since_ns)
        if checked.reinitialise:
            self._tracker.reinitialise(checked.n_reinitialised, keep=not checked.young)
            self._motion.reset()
            self._attitude.reset()
            self._odometry.discard_map(segment.first_keyframe_id, checked.tilt_rad)
        return checked.warnings
