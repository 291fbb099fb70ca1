"""Consistency of the measured attitude with the camera and the map in flight.

Where the vertical of the map moves against the autopilot, one of three is wrong: a young map, which
is reinitialised; the mount, which is constant and estimated; or the assumption that the attitude is
that of the camera (gimbal): then attitude is ignored until rotations agree again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.estimation.attitude.attitude_following import RotationAgreement, RotationComparison
from companion.estimation.attitude.attitude_history import AttitudeHistory
from companion.estimation.attitude.head_yaw import HeadYaw
from companion.estimation.attitude.map_tilt import MapTilt, RotationOf
from companion.geometry.transforms import Array, angle_between
from companion.messages import Warned
from companion.telemetry import AttitudeSample

CHECK_NS, CHECK_OLD_NS = 200_000_000, 1_000_000_000
"""Period of tilt checks, in maps not yet known to be consistent, and later."""
ROTATION_CHECK_NS = 2_000_000_000
"""Period of rotation comparisons."""
MAX_TILT_RAD = np.radians(6.4)
"""Largest change of the vertical: poses tilted by more are not sent."""
MIN_TILTED_NS = 500_000_000
"""Single keyframes of young maps are often tilted until adjusted, which takes less."""
CONSISTENT_NS = 10_000_000_000
"""A map consistent for so long is not the one that is wrong."""
MAX_REINITIALISATIONS = 3
"""Successive inconsistent maps after which the attitude is held to be wrong."""
N_AGREEING = 2
"""Successive rotation comparisons with the same result that are required."""
RETRY_NS, MAX_RETRY_NS = 10_000_000_000, 160_000_000_000
"""Time before an ignored attitude is used again; doubled each time."""

REINITIALISED = "map tilted against the autopilot's attitude: begun anew"
NOT_BODY_FIXED = "camera does not turn with the body: attitude not used, no vision position"
MOUNT_DISAGREES = "camera mount disagrees with the autopilot's attitude: no vision position"
BODY_FIXED_AGAIN = "camera turns with the body again: attitude used"
GIMBAL_DISAGREES = "the gimbal's angles do not fit the camera: no vision position"
GIMBAL_AGAIN = "the gimbal's angles fit the camera again"


@dataclass(frozen=True, slots=True)
class Verdict:
    """A warning, and what to do with map and attitudes.

    With `reinitialise` the active map, which is off by `tilt_rad`, is discarded, for the
    `n_reinitialised`th time in a row, entirely if it is `young`. Attitudes since `invalid_since_ns`
    were not those of the camera. With `mount` the cause is, or was until now, the mount.
    """

    warning: Warned
    reinitialise: bool = False
    tilt_rad: float = 0.0
    young: bool = True
    invalid_since_ns: int | None = None
    mount: bool = False


class AttitudeVerdict:
    """Checks attitudes and tracked frames periodically; the verdict can be revised."""

    def __init__(self, history: AttitudeHistory, head_yaw: HeadYaw | None = None) -> None:
        self._head_yaw = head_yaw
        """Of a gimbal, whose head's attitude it is; None of a camera fixed to the body."""
        self.used = True
        """True while the attitude is taken for that of the camera."""
        self.n_reinitialised = 0
        """Maps reinitialised since the last consistent one."""
        self._history = history
        self._rotations, self._tilt = RotationComparison(), MapTilt()
        self._check_due_ns = self._rotations_due_ns = 0
        self._agreement: RotationAgreement | None = None
        self._n_stabilised = self._n_independent = self._n_body_fixed = 0
        self._agreed_ns: int | None = None
        """Time at which the attitude was last known to be that of the camera."""
        self._tilted_since_ns: int | None = None
        self._consistent = False
        """True once the active map has been consistent with the attitude for long enough."""
        self._retry_ns = RETRY_NS
        self._not_before_ns = 0
        self._mount = False
        """True while the attitude is ignored because of the mount."""

    def add(self, sample: AttitudeSample) -> None:
        """Add an attitude of the autopilot, which is in the history too."""
        self._rotations.add(sample)

    def take(
        self, t_ns: int, map_from_camera: Array, keyframe_id: int, keyframe_from_camera: Array
    ) -> None:
        """Add the rotations (3, 3) of a tracked frame, in the map and relative to its keyframe."""
        self._rotations.take(t_ns, map_from_camera)
        self.take_backfilled(t_ns, keyframe_id, keyframe_from_camera)

    def take_backfilled(self, t_ns: int, keyframe_id: int, keyframe_from_camera: Array) -> None:
        """Add a frame from before initialisation, tracked afterwards."""
        if self.used:
            self._tilt.take(t_ns, keyframe_id, keyframe_from_camera, self._history)

    def reset(self) -> None:
        """Clear state after another map became active."""
        self._rotations.reset()
        self._reset_tilt()
        if self._head_yaw is not None:
            self._head_yaw.reset()

    def _reset_tilt(self) -> None:
        self._tilt.reset()
        self._consistent, self._tilted_since_ns = False, None

    def due(self, t_ns: int) -> bool:
        """True if a check is due at flight time `t_ns`."""
        doubted = self.used and self._head_yaw is not None and self._head_yaw.doubted
        return (
            doubted or t_ns >= self._rotations_due_ns or (self.used and t_ns >= self._check_due_ns)
        )

    def check(
        self, t_ns: int, rotation_of: RotationOf, body_from_camera: Array,
        ned_from_map: Array | None,
    ) -> Verdict | None:  # fmt: skip
        """Check; a verdict if something is to be done.

        `ned_from_map` (3, 3) is the georeference rotation, None where unknown.
        """
        if self.used and self._head_yaw is not None:
            since_ns = self._head_yaw.moved_since_ns()
            if since_ns is None:
                since_ns = self._head_yaw.far_since_ns(t_ns, ned_from_map)
            if since_ns is not None:
                self._agreed_ns = since_ns
                off_deg = np.degrees(self._head_yaw.off_rad)
                return self._reject(
                    t_ns, GIMBAL_DISAGREES, f"its yaw is {off_deg:+.0f} degrees off"
                )
        if t_ns >= self._rotations_due_ns:
            self._rotations_due_ns = t_ns + ROTATION_CHECK_NS
            self._agreement = self._rotations.result(body_from_camera)
            verdict = self._check_rotations(t_ns, self._agreement, ned_from_map)
            if verdict is not None:
                return verdict
        if self.used and t_ns >= self._check_due_ns:
            self._check_due_ns = t_ns + (CHECK_OLD_NS if self._consistent else CHECK_NS)
            return self._check_tilt(t_ns, rotation_of, body_from_camera, ned_from_map)
        return None

    def _check_rotations(
        self, t_ns: int, found: RotationAgreement | None, ned_from_map: Array | None
    ) -> Verdict | None:
        if found is None:
            return None
        self._n_stabilised = self._n_stabilised + 1 if found.stabilised else 0
        fits = found.body_fixed if self._head_yaw is None else found.fits
        self._n_body_fixed = self._n_body_fixed + 1 if fits else 0
        # rotation relative to a young, bending map looks independent, too
        independent = found.rotates_independently and self._consistent
        self._n_independent = self._n_independent + 1 if independent else 0
        if self.used:
            if fits:
                self._agreed_ns = t_ns
            if max(self._n_stabilised, self._n_independent) >= N_AGREEING:
                return self._reject(t_ns, NOT_BODY_FIXED)
        elif self._n_body_fixed >= N_AGREEING and t_ns >= self._not_before_ns:
            what = BODY_FIXED_AGAIN
            if self._head_yaw is not None:
                self._head_yaw.far_since_ns(t_ns, ned_from_map)
                if not self._head_yaw.fits_again(t_ns):
                    return None
                self._head_yaw.believe()
                what = GIMBAL_AGAIN
            self.used, self.n_reinitialised = True, 0
            self._reset_tilt()  # earlier attitudes were not all those of the camera
            return Verdict(Warned(t_ns, what, good=True), mount=self._mount)
        return None

    def _check_tilt(
        self, t_ns: int, rotation_of: RotationOf, body_from_camera: Array,
        ned_from_map: Array | None,
    ) -> Verdict | None:  # fmt: skip
        found = self._tilt.result(rotation_of, body_from_camera)
        if found is None:
            return None
        agreement = self._agreement
        moved_rad = found.spread_rad
        if agreement is None or not agreement.body_fixed:
            moved_rad = min(moved_rad, found.spread_with_gimbal_rad())
        max_moved_rad, absolute_rad = float(MAX_TILT_RAD), 0.0
        if ned_from_map is not None and found.mount_rad < float(MAX_TILT_RAD):
            cosine = float((ned_from_map @ found.map_from_ned)[2, 2])
            absolute_rad = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
            contradicted = agreement is None or agreement.rotates_otherwise
            if self._consistent and not contradicted and absolute_rad < float(MAX_TILT_RAD):
                # Neither map nor mount moves, and the autopilot's vertical, which swings where its
                # own aiding has failed for seconds, may be off that of the map to both sides.
                max_moved_rad = 2.0 * float(MAX_TILT_RAD)
        if moved_rad < max_moved_rad and absolute_rad < float(MAX_TILT_RAD):
            self._tilted_since_ns = None
            if found.spread_rad < float(MAX_TILT_RAD):
                self._agreed_ns = t_ns
                if found.span_ns > CONSISTENT_NS:
                    self._consistent, self.n_reinitialised, self._retry_ns = True, 0, RETRY_NS
            return None
        if self._tilted_since_ns is None:
            self._tilted_since_ns = t_ns
        if t_ns - self._tilted_since_ns < MIN_TILTED_NS:
            return None
        if moved_rad >= max_moved_rad and self._consistent:
            return self._reject(t_ns, NOT_BODY_FIXED)
        if self.n_reinitialised >= MAX_REINITIALISATIONS:
            return self._reject(t_ns, MOUNT_DISAGREES)
        self.n_reinitialised += 1
        tilt_rad = max(moved_rad, absolute_rad)
        young = not self._consistent
        self.reset()
        detail = (
            f"by {np.degrees(tilt_rad):.0f} degrees, number {self.n_reinitialised} of "
            f"{MAX_REINITIALISATIONS} in a row"
        )
        warning = Warned(t_ns, REINITIALISED, detail)
        return Verdict(warning, reinitialise=True, tilt_rad=tilt_rad, young=young)

    def reject_mount(self, t_ns: int, why: str) -> Verdict:
        """Ignore the attitude until rotations agree again: the mount was found to be wrong."""
        return self._reject(t_ns, MOUNT_DISAGREES, why)

    def _reject(self, t_ns: int, what: str, why: str = "") -> Verdict:
        """Ignore the attitude until rotations agree again."""
        since_ns = self._agreed_ns if self._agreed_ns is not None else 0
        self.used, self._mount = False, what == MOUNT_DISAGREES
        if self._head_yaw is not None:
            what = GIMBAL_DISAGREES
        self._not_before_ns = t_ns + self._retry_ns
        self._retry_ns = min(2 * self._retry_ns, MAX_RETRY_NS)
        self._n_stabilised = self._n_independent = self._n_body_fixed = 0
        self._reset_tilt()
        warning = Warned(
            t_ns, what, why or _description(self._agreement, self._head_yaw is not None)
        )
        return Verdict(warning, invalid_since_ns=since_ns, mount=self._mount)


def _description(found: RotationAgreement | None, of_gimbal: bool) -> str:
    """Findings of the rotation comparison in words, with advice."""
    if found is None:
        return "check how the camera is mounted, and mount.* in the configuration"
    if found.mount_correction is not None and not found.body_fixed:
        off_deg = np.degrees(angle_between(found.mount_correction, np.eye(3)))
        return f"it sits turned by {off_deg:.0f} degrees from what is stated; check mount.*"
    gains = ", ".join(
        f"{name} {gain:.1f}"
        for name, gain in zip(("roll", "pitch", "yaw"), found.gain, strict=True)
        if np.isfinite(gain)
    )
    alone_deg = np.degrees(found.residual_rad)
    return (
        f"of the body's turns it makes this share: {gains or 'unknown'}; turned by "
        f"{alone_deg:.1f} degrees in half a second by itself; "
        + ("are its angles in other axes than told?" if of_gimbal else "is there a gimbal?")
    )
