"""The camera's attitude as the autopilot tells it, if that is the camera's at all.

Mount and clock are corrected in flight; an attitude that is not the camera's (a gimbal) is left
aside until it is.
"""

from __future__ import annotations

from collections.abc import Set
from typing import NamedTuple

import numpy as np

from companion.estimation.attitude_verdict import AttitudeVerdict
from companion.estimation.map_tilt import RotationOf
from companion.estimation.motion_filter import AttitudeHistory
from companion.estimation.mount_estimation import RATE_STEP_NS, MountEstimate, MountEstimator
from companion.geometry.transforms import Array, Pose, angle_between, rotation_from_vector
from companion.messages import AttitudeSample, Track, Warned

MOUNT_EVERY_NS = 3_000_000_000
MIN_MOUNT_RAD, MIN_LATE_S = np.radians(0.3), 0.006
"""Corrections of mount and clock that are not worth making."""
TOLD_DEG, TOLD_S = 1.5, 0.025
"""Corrections that somebody should know of."""


class Judged(NamedTuple):
    """What came of a look at the attitude.

    After a correction `now_from_before` (3, 3) turns what was told in the camera's axes by the
    mount as it was, and `before_from_now_ned` (3, 3) is by what the frame's attitude was off. With
    `reinitialise` the map in use is tilted, and of no use at all if it is `young`; `n_anew` is how
    many in a row were. Attitudes since `disowned_since_ns` were not the camera's.
    """

    warnings: list[Warned]
    now_from_before: Array | None = None
    before_from_now_ned: Array | None = None
    reinitialise: bool = False
    young: bool = True
    n_anew: int = 0
    disowned_since_ns: int | None = None


class CameraAttitude:
    """Takes the autopilot's attitudes, and the camera's own turns to judge them by."""

    def __init__(self, body_from_camera: Pose | None) -> None:
        self._mounted = body_from_camera is not None
        self._history = AttitudeHistory()
        self._verdict = AttitudeVerdict(self._history)
        self._disowned: list[tuple[int, int | None]] = []
        """From when to when, or until now, the attitude was not the camera's."""
        self._mount = body_from_camera.rotation if body_from_camera is not None else np.eye(3)
        self._late_ns = 0
        """What the autopilot's stamps were found to be late by."""
        self._estimator = MountEstimator(self._mount)
        self._told = False
        self._due_ns = 0
        self._kept: dict[int, tuple[Array, Array] | None] = {}
        """`ned_from_body` and body rates of keyframes, kept when the history has moved on."""

    @property
    def used(self) -> bool:
        """Whether it tells anything of the camera."""
        return self._mounted and self._verdict.used

    def add(self, sample: AttitudeSample) -> None:
        """Take what the autopilot says."""
        self._history.add(sample)
        self._verdict.add(sample)

    def at(self, t_ns: int) -> Array | None:
        """Rotation `ned_from_camera` (3, 3) of a frame; None where it is not known."""
        if not self.used or self._is_disowned(t_ns):
            return None
        attitude = self._history.at(t_ns + self._late_ns)
        return None if attitude is None else attitude @ self._mount

    def of_keyframe(self, keyframe_id: int, t_ns: int) -> Array | None:
        """The same of a keyframe, interpolated once samples from after it have come."""
        if not self.used or self._is_disowned(t_ns):
            return None
        if keyframe_id not in self._kept:
            if self._history.newest_t_ns < t_ns + RATE_STEP_NS:
                return self.at(t_ns)
            self._kept[keyframe_id] = self._history.with_rates_at(t_ns, RATE_STEP_NS)
        kept = self._kept[keyframe_id]
        if kept is None:
            return None
        attitude, rates = kept
        return attitude @ rotation_from_vector(rates * (self._late_ns * 1e-9)) @ self._mount

    def let_go(self, living: Set[int]) -> None:
        """Forget what was kept of keyframes that are no more among these."""
        self._kept = {key: kept for key, kept in self._kept.items() if key in living}

    @property
    def correction(self) -> tuple[Array, int]:
        """The mount's rotation `body_from_camera` (3, 3), and how late stamps are, ns; as found."""
        return self._mount, self._late_ns

    def take_up(
        self, body_from_camera: Array, late_ns: int, ned_from_camera: dict[int, Array | None]
    ) -> None:
        """Use a correction that was found before, and what keyframes were told by their ids.

        To be called before the first frame.
        """
        self._mount, self._late_ns = body_from_camera, late_ns
        for keyframe_id, told in ned_from_camera.items():
            still = np.zeros(3)
            self._kept[keyframe_id] = None if told is None else (told @ self._mount.T, still)

    def _is_disowned(self, t_ns: int) -> bool:
        return any(a <= t_ns and (b is None or t_ns < b) for a, b in self._disowned)

    def compare(self, track: Track, map_from_camera: Array) -> None:
        """Take a tracked frame and its rotation (3, 3) in the map in use."""
        if not self._mounted:
            return
        if track.backfilled:
            relative = track.keyframe_from_camera
            if track.keyframe_id is not None and relative is not None:
                self._verdict.take_earlier(track.t_ns, track.keyframe_id, relative.rotation)
            return
        self._estimator.take(track.t_ns, map_from_camera, self._history)
        if track.keyframe_id is not None and track.keyframe_from_camera is not None:
            self._verdict.take(
                track.t_ns, map_from_camera, track.keyframe_id,
                track.keyframe_from_camera.rotation,
            )  # fmt: skip

    def forget(self) -> None:
        """Another map is in use: its turns are not comparable with those of the last."""
        self._estimator.forget()
        self._verdict.forget()

    def due(self, t_ns: int) -> bool:
        """Whether it is time to judge."""
        mount_due = self.used and t_ns >= self._due_ns
        return self._mounted and (mount_due or self._verdict.due(t_ns))

    def judge(self, t_ns: int, rotation_of: RotationOf, ned_from_map: Array | None) -> Judged:
        """See how far the attitude is the camera's, and the map level: correct what is off.

        `rotation_of` tells how keyframes lie in the map in use, `ned_from_map` (3, 3) how that is
        placed in the world, None where it is not.
        """
        if not self._mounted:
            return Judged([])
        verdict = self._verdict.judge(t_ns, rotation_of, self._mount, ned_from_map)
        if verdict is not None:
            if verdict.disowned_since_ns is not None:
                self._disowned.append((verdict.disowned_since_ns, None))
            elif self._disowned and self._disowned[-1][1] is None and self.used:
                self._disowned[-1] = (self._disowned[-1][0], t_ns)
                if not verdict.mount:
                    self._estimator.forget()  # it was given a gimbal's turns
            return Judged(
                [verdict.warning], reinitialise=verdict.reinitialise, young=verdict.young,
                n_anew=self._verdict.n_anew, disowned_since_ns=verdict.disowned_since_ns,
            )  # fmt: skip
        if not self.used or t_ns < self._due_ns:
            return Judged([])
        self._due_ns = t_ns + MOUNT_EVERY_NS
        found = self._estimator.estimate()
        return self._correct(t_ns, found) if found is not None and found.certain else Judged([])

    def _correct(self, t_ns: int, found: MountEstimate) -> Judged:
        """Use the mount and the clock as they were found to be; say so where they are far off."""
        off_rad = angle_between(self._mount, found.body_from_camera)
        off_s = abs(found.offset_s - self._late_ns * 1e-9)
        sigma_rad = float(np.linalg.norm(found.sigma_turn_rad))
        if off_rad < max(sigma_rad, MIN_MOUNT_RAD) and off_s < max(
            2.0 * found.sigma_offset_s, MIN_LATE_S
        ):
            return Judged([])
        now_from_before = found.body_from_camera.T @ self._mount
        before = self.at(t_ns)
        self._mount = found.body_from_camera
        self._late_ns = int(found.offset_s * 1e9)
        after = self.at(t_ns)
        turned = None if before is None or after is None else before @ after.T
        turn = np.degrees(found.turn_camera_rad)
        slight = float(np.linalg.norm(turn)) < TOLD_DEG and abs(found.offset_s) < TOLD_S
        if self._told or slight:
            return Judged([], now_from_before, turned)
        self._told = True
        about = " ".join(f"{v:+.1f}" for v in turn)
        detail = (
            f"the camera is turned by {about} degrees about its right, down and forward axes, "
            f"telemetry is {found.offset_s * 1e3:+.0f} ms late; put that into the calibration"
        )
        warned = Warned(t_ns, "camera and autopilot were found to disagree, corrected", detail)
        return Judged([warned], now_from_before, turned)
