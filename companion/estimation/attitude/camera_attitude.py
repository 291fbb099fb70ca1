"""Camera attitude from the autopilot, with mount and clock corrected in flight.

An attitude that is not that of the camera (gimbal) is ignored. With a gimbal whose angles are told
the attitude is that of its head, which takes the place of the body.
"""

from __future__ import annotations

from collections.abc import Set
from typing import NamedTuple

import numpy as np

from companion.estimation.attitude.attitude_history import AttitudeHistory
from companion.estimation.attitude.attitude_verdict import AttitudeVerdict, Verdict
from companion.estimation.attitude.head_yaw import HeadYaw
from companion.estimation.attitude.map_tilt import RotationOf
from companion.estimation.attitude.mount_estimation import (
    FITS_RAD,
    RATE_STEP_NS,
    MountEstimate,
    MountEstimator,
)
from companion.geometry.gimbal import Gimbal
from companion.geometry.transforms import Array, Pose, angle_between, rotation_from_vector
from companion.messages import Track, Warned
from companion.telemetry import AttitudeSample

MAX_HEAD_EXTRAPOLATION_NS = 250_000_000
"""A head is steadier than a body, and gimbals send their angles 5 times a second."""
MOUNT_EVERY_NS = 3_000_000_000
MIN_MOUNT_RAD, MIN_DELAY_S = np.radians(0.3), 0.006
"""Smaller corrections of mount and delay are not applied."""
REPORTED_S = 0.025
"""Larger corrections of the delay are reported to the user."""
MOUNT_FITS = "camera turns with the body as its mount says"


class AttitudeCheck(NamedTuple):
    """Result of a check of the attitude.

    After a correction `now_from_before` (3, 3) rotates measurements in camera axes by the mount
    before, and `before_from_now_ned` (3, 3) is the change of the attitude of the frame. With
    `reinitialise` the active map is tilted by `tilt_rad`, useless if `young`; `n_reinitialised`
    counts successive ones. Attitudes since `invalid_since_ns` were not those of the camera.
    """

    warnings: list[Warned]
    now_from_before: Array | None = None
    before_from_now_ned: Array | None = None
    reinitialise: bool = False
    tilt_rad: float = 0.0
    young: bool = True
    n_reinitialised: int = 0
    invalid_since_ns: int | None = None


class CameraAttitude:
    """Attitudes of the autopilot, checked against the rotations of the camera."""

    def __init__(self, body_from_camera: Pose | None, gimbal: Gimbal | None = None) -> None:
        self._mounted = body_from_camera is not None
        self._yaw = None if gimbal is None else HeadYaw(float(np.radians(gimbal.sigma_deg)))
        self._history = (
            AttitudeHistory()
            if gimbal is None
            else AttitudeHistory(max_extrapolation_ns=MAX_HEAD_EXTRAPOLATION_NS)
        )
        self._verdict = AttitudeVerdict(self._history, self._yaw)
        self._invalid_spans: list[tuple[int, int | None]] = []
        """Spans, the last one possibly open, in which the attitude was not that of the camera."""
        self._mount = body_from_camera.rotation if body_from_camera is not None else np.eye(3)
        self._delay_ns = 0 if gimbal is None else round(gimbal.delay_ms * 1e6)
        """Estimated delay of autopilot stamps, of a gimbal's with one."""
        self._estimator = MountEstimator(self._mount)
        self._reported = self._proven = False
        self._due_ns = 0
        self._keyframe_attitudes: dict[int, tuple[Array, Array] | None] = {}
        """`ned_from_body` and body rates of keyframes, kept beyond the history."""

    @property
    def used(self) -> bool:
        """True while the autopilot's attitude is used for that of the camera."""
        return self._mounted and self._verdict.used

    def add(self, sample: AttitudeSample) -> None:
        """Add an attitude."""
        self._history.add(sample)
        self._verdict.add(sample)

    def at(self, t_ns: int) -> Array | None:
        """Rotation `ned_from_camera` (3, 3) of a frame; None where unknown."""
        if not self.used or self._is_invalid(t_ns):
            return None
        attitude = self._history.at(t_ns + self._delay_ns)
        return None if attitude is None else attitude @ self._mount

    def rates_at(self, t_ns: int, half_span_ns: int) -> Array | None:
        """Mean angular rate (3,) of the camera in its axes, rad/s, over a span about a time.

        None where unknown.
        """
        if not self.used or self._is_invalid(t_ns):
            return None
        found = self._history.with_rates_at(t_ns + self._delay_ns, half_span_ns)
        return None if found is None else self._mount.T @ found[1]

    def of_keyframe(self, keyframe_id: int, t_ns: int) -> Array | None:
        """The same of a keyframe, interpolated once later samples have arrived."""
        if not self.used or self._is_invalid(t_ns):
            return None
        if keyframe_id not in self._keyframe_attitudes:
            if self._history.newest_t_ns < t_ns + RATE_STEP_NS:
                return self.at(t_ns)
            self._keyframe_attitudes[keyframe_id] = self._history.with_rates_at(t_ns, RATE_STEP_NS)
        kept = self._keyframe_attitudes[keyframe_id]
        if kept is None:
            return None
        attitude, rates = kept
        return attitude @ rotation_from_vector(rates * (self._delay_ns * 1e-9)) @ self._mount

    def prune(self, living: Set[int]) -> None:
        """Drop attitudes of keyframes that are not among `living`."""
        self._keyframe_attitudes = {
            key: kept for key, kept in self._keyframe_attitudes.items() if key in living
        }

    @property
    def correction(self) -> tuple[Array, int]:
        """Estimated mount rotation `body_from_camera` (3, 3), and delay of stamps, ns."""
        return self._mount, self._delay_ns

    @property
    def imu_delay_ns(self) -> int:
        """Delay of the stamps of the autopilot's IMU, taken as that of its attitude.

        With a gimbal the delay is of the gimbal's stamps, and nothing is known of the others.
        """
        return self._delay_ns if self._yaw is None else 0

    @property
    def doubted(self) -> bool:
        """True if the attitude, a gimbal's, does not fit the newest frame."""
        return self._yaw is not None and self._yaw.doubted

    def resume(
        self, body_from_camera: Array, delay_ns: int, ned_from_camera: dict[int, Array | None]
    ) -> None:
        """Restore a correction, and attitudes of keyframes by id.

        Before the first frame.
        """
        self._mount, self._delay_ns = body_from_camera, delay_ns
        for keyframe_id, attitude in ned_from_camera.items():
            no_rates = np.zeros(3)
            self._keyframe_attitudes[keyframe_id] = (
                None if attitude is None else (attitude @ self._mount.T, no_rates)
            )

    def _is_invalid(self, t_ns: int) -> bool:
        return any(a <= t_ns and (b is None or t_ns < b) for a, b in self._invalid_spans)

    def compare(self, track: Track, map_from_camera: Array, corrected_rad: float = 0.0) -> None:
        """Add a tracked frame with its rotation (3, 3) in the active map.

        With a gimbal it counts that the autopilot has corrected its heading by `corrected_rad`.
        """
        if not self._mounted:
            return
        if track.backfilled:
            relative = track.keyframe_from_camera
            if track.keyframe_id is not None and relative is not None:
                self._verdict.take_backfilled(track.t_ns, track.keyframe_id, relative.rotation)
            return
        self._estimator.take(track.t_ns, map_from_camera, self._history)
        head = None if self._yaw is None else self._history.at(track.t_ns + self._delay_ns)
        if self._yaw is not None and head is not None:
            self._yaw.take(track.t_ns, map_from_camera, head @ self._mount, corrected_rad)
        if track.keyframe_id is not None and track.keyframe_from_camera is not None:
            self._verdict.take(
                track.t_ns, map_from_camera, track.keyframe_id,
                track.keyframe_from_camera.rotation,
            )  # fmt: skip

    def reset(self) -> None:
        """Clear rotations, which are not comparable between maps."""
        self._estimator.reset()
        self._verdict.reset()

    def due(self, t_ns: int) -> bool:
        """True if a check is due at flight time `t_ns`."""
        mount_due = self.used and t_ns >= self._due_ns
        return self._mounted and (mount_due or self._verdict.due(t_ns))

    def check(
        self, t_ns: int, rotation_of: RotationOf, ned_from_map: Array | None
    ) -> AttitudeCheck:
        """Check the attitude and the level of the map; correct the mount and the delay.

        `rotation_of` gives rotations of keyframes in the active map, `ned_from_map` (3, 3) that of
        the map, None where unknown.
        """
        if not self._mounted:
            return AttitudeCheck([])
        verdict = self._verdict.check(t_ns, rotation_of, self._mount, ned_from_map)
        if verdict is not None:
            return self._judged(t_ns, verdict)
        if not self.used or t_ns < self._due_ns:
            return AttitudeCheck([])
        self._due_ns = t_ns + MOUNT_EVERY_NS
        found = self._estimator.estimate()
        if found is None or not found.certain:
            return AttitudeCheck([])
        checked = self._correct(t_ns, found)
        if found.fits and not self._proven:
            self._proven = True
            off_deg = np.degrees(np.linalg.norm(found.turn_camera_rad))
            detail = f"within {off_deg:.1f} degrees"
            checked.warnings.append(Warned(t_ns, MOUNT_FITS, detail, good=True))
        return checked

    def contradicted(self, t_ns: int, why: str) -> AttitudeCheck:
        """Ignore the attitude, as the camera sits otherwise than stated, by other evidence.

        The map, which was levelled by it, is useless.
        """
        return self._judged(t_ns, self._verdict.reject_mount(t_ns, why))._replace(reinitialise=True)

    def _judged(self, t_ns: int, verdict: Verdict) -> AttitudeCheck:
        """Consequences of a verdict."""
        if verdict.invalid_since_ns is not None:
            self._invalid_spans.append((verdict.invalid_since_ns, None))
        elif self._invalid_spans and self._invalid_spans[-1][1] is None and self.used:
            self._invalid_spans[-1] = (self._invalid_spans[-1][0], t_ns)
            if not verdict.mount:
                self._estimator.reset()  # its rotations were those of a gimbal
        return AttitudeCheck(
            [verdict.warning], reinitialise=verdict.reinitialise, tilt_rad=verdict.tilt_rad,
            young=verdict.young, n_reinitialised=self._verdict.n_reinitialised,
            invalid_since_ns=verdict.invalid_since_ns,
        )  # fmt: skip

    def _correct(self, t_ns: int, found: MountEstimate) -> AttitudeCheck:
        """Apply an estimate of mount and delay; report large corrections."""
        off_rad = angle_between(self._mount, found.body_from_camera)
        off_s = abs(found.offset_s - self._delay_ns * 1e-9)
        sigma_rad = float(np.linalg.norm(found.sigma_turn_rad))
        if off_rad < max(sigma_rad, MIN_MOUNT_RAD) and off_s < max(
            2.0 * found.sigma_offset_s, MIN_DELAY_S
        ):
            return AttitudeCheck([])
        now_from_before = found.body_from_camera.T @ self._mount
        before = self.at(t_ns)
        self._mount = found.body_from_camera
        self._delay_ns = int(found.offset_s * 1e9)
        after = self.at(t_ns)
        attitude_change = None if before is None or after is None else before @ after.T
        off_by_rad = float(np.linalg.norm(found.turn_camera_rad))
        slight = off_by_rad < float(FITS_RAD) and abs(found.offset_s) < REPORTED_S
        if self._reported or slight:
            return AttitudeCheck([], now_from_before, attitude_change)
        self._reported = True
        about = " ".join(f"{v:+.1f}" for v in np.degrees(found.turn_camera_rad))
        detail = (
            f"the camera is turned by {about} degrees about its right, down and forward axes, "
            f"telemetry is {found.offset_s * 1e3:+.0f} ms late; put that into the calibration"
        )
        warned = Warned(t_ns, "camera and autopilot were found to disagree, corrected", detail)
        return AttitudeCheck([warned], now_from_before, attitude_change)
