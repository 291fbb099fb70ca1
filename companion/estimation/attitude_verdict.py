"""Is the attitude the camera's, and is the map level: what each says of the other in flight.

Where the map's vertical moves against the autopilot's, one of three is wrong. The map, if it is
young: it begins anew. The camera's mount, which is constant and is fitted. Or the attitude is not
the camera's, because a gimbal turns it: it is left aside, and used again once turns agree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.estimation.attitude_following import Following, FollowingTest
from companion.estimation.map_tilt import MapTilt, RotationOf
from companion.estimation.motion_filter import AttitudeHistory
from companion.geometry.transforms import Array, angle_between
from companion.messages import AttitudeSample, Warned

CHECK_NS, CHECK_OLD_NS = 200_000_000, 1_000_000_000
"""How often the vertical is looked at, in a map that is not yet known to be straight and later."""
TURNS_NS = 2_000_000_000
"""How often turns are compared."""
MAX_TILT_RAD = np.radians(6.4)
"""What a vertical may move by: a pose that is tilted by more is not begun to be sent."""
BENT_NS = 500_000_000
"""A keyframe or two of a young map are often tilted until they are adjusted; so few take less."""
STRAIGHT_NS = 10_000_000_000
"""A map that was straight for so long is not the one that is wrong."""
MOST_ANEW = 3
"""So many maps in a row that disagree with an attitude are right, and it is not theirs."""
AGREEING = 2
"""Comparisons of turns, one after the other, that speak for the same."""
WAIT_NS, MAX_WAIT_NS = 10_000_000_000, 160_000_000_000
"""An attitude that was left aside is not used again sooner; twice as long each time."""

BEGUN_ANEW = "map tilted against the autopilot's attitude: begun anew"
NOT_FOLLOWED = "camera does not turn with the body: attitude not used, no vision position"
MOUNT_DISAGREES = "camera mount disagrees with the autopilot's attitude: no vision position"
FOLLOWED_AGAIN = "camera turns with the body again: attitude used"


@dataclass(frozen=True, slots=True)
class Verdict:
    """What is to be done: a word to whom it concerns, and what becomes of map and attitudes.

    The map in use begins anew with `reinitialise`, the `n_anew`th in a row, and is of no use at all
    if it is `young`. Attitudes since `disowned_since_ns` were not the camera's. With `mount` it is,
    or was until now, how the camera sits on the body that was wrong.
    """

    warning: Warned
    reinitialise: bool = False
    young: bool = True
    disowned_since_ns: int | None = None
    mount: bool = False


class AttitudeVerdict:
    """Takes attitudes and tracked frames, judges every so often, and can change its mind."""

    def __init__(self, history: AttitudeHistory) -> None:
        self.used = True
        """Whether the attitude is the camera's."""
        self.n_anew = 0
        """Maps that have begun anew since the last that was straight."""
        self._history = history
        self._turns, self._tilt = FollowingTest(), MapTilt()
        self._check_due_ns = self._turns_due_ns = 0
        self._following: Following | None = None
        self._n_held = self._n_alone = self._n_follows = 0
        self._agreed_ns: int | None = None
        """When the attitude was last known to be the camera's."""
        self._tilted_since_ns: int | None = None
        self._straight = False
        """Whether the map in use was straight for long."""
        self._wait_ns = WAIT_NS
        self._not_before_ns = 0
        self._mount = False
        """Whether the mount is why the attitude is left aside."""

    def add(self, sample: AttitudeSample) -> None:
        """Take the autopilot's attitude, which the history has too."""
        self._turns.add(sample)

    def take(
        self, t_ns: int, map_from_camera: Array, keyframe_id: int, keyframe_from_camera: Array
    ) -> None:
        """Take the rotations (3, 3) of a tracked frame, in the map and against its keyframe."""
        self._turns.take(t_ns, map_from_camera)
        self.take_earlier(t_ns, keyframe_id, keyframe_from_camera)

    def take_earlier(self, t_ns: int, keyframe_id: int, keyframe_from_camera: Array) -> None:
        """Take a frame from before the map began, which was placed in it later."""
        if self.used:
            self._tilt.take(t_ns, keyframe_id, keyframe_from_camera, self._history)

    def forget(self) -> None:
        """Another map is in use."""
        self._turns.forget()
        self._forget_tilt()

    def _forget_tilt(self) -> None:
        self._tilt.forget()
        self._straight, self._tilted_since_ns = False, None

    def due(self, t_ns: int) -> bool:
        """Whether it is time to judge."""
        return t_ns >= self._turns_due_ns or (self.used and t_ns >= self._check_due_ns)

    def judge(
        self, t_ns: int, rotation_of: RotationOf, body_from_camera: Array,
        ned_from_map: Array | None,
    ) -> Verdict | None:  # fmt: skip
        """See what is to be done, if anything.

        `ned_from_map` (3, 3) is how the map is placed in the world, None where it is not.
        """
        if t_ns >= self._turns_due_ns:
            self._turns_due_ns = t_ns + TURNS_NS
            self._following = self._turns.result(body_from_camera)
            verdict = self._judge_turns(t_ns, self._following)
            if verdict is not None:
                return verdict
        if self.used and t_ns >= self._check_due_ns:
            self._check_due_ns = t_ns + (CHECK_OLD_NS if self._straight else CHECK_NS)
            return self._judge_tilt(t_ns, rotation_of, body_from_camera, ned_from_map)
        return None

    def _judge_turns(self, t_ns: int, found: Following | None) -> Verdict | None:
        if found is None:
            return None
        self._n_held = self._n_held + 1 if found.held else 0
        self._n_follows = self._n_follows + 1 if found.follows else 0
        # a young map that bends turns the camera alone, too
        alone = found.turns_alone and self._straight
        self._n_alone = self._n_alone + 1 if alone else 0
        if self.used:
            if found.follows:
                self._agreed_ns = t_ns
            if max(self._n_held, self._n_alone) >= AGREEING:
                return self._drop(t_ns, NOT_FOLLOWED)
        elif self._n_follows >= AGREEING and t_ns >= self._not_before_ns:
            self.used, self.n_anew = True, 0
            self._forget_tilt()  # the turns until now were not all the camera's
            return Verdict(Warned(t_ns, FOLLOWED_AGAIN, good=True), mount=self._mount)
        return None

    def _judge_tilt(
        self, t_ns: int, rotation_of: RotationOf, body_from_camera: Array,
        ned_from_map: Array | None,
    ) -> Verdict | None:  # fmt: skip
        found = self._tilt.result(rotation_of, body_from_camera)
        if found is None:
            return None
        follows = self._following is not None and self._following.follows
        bent_rad = found.spread_rad if follows else found.beside_gimbal_rad()
        placed_rad = 0.0
        if ned_from_map is not None and found.mount_rad < float(MAX_TILT_RAD):
            cosine = float((ned_from_map @ found.map_from_ned)[2, 2])
            placed_rad = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
        if max(bent_rad, placed_rad) < float(MAX_TILT_RAD):
            self._tilted_since_ns = None
            if found.spread_rad < float(MAX_TILT_RAD):
                self._agreed_ns = t_ns
                if found.span_ns > STRAIGHT_NS:
                    self._straight, self.n_anew, self._wait_ns = True, 0, WAIT_NS
            return None
        if self._tilted_since_ns is None:
            self._tilted_since_ns = t_ns
        if t_ns - self._tilted_since_ns < BENT_NS:
            return None
        bent = bent_rad >= float(MAX_TILT_RAD)
        if bent and self._straight:
            return self._drop(t_ns, NOT_FOLLOWED)
        if self.n_anew >= MOST_ANEW:
            return self._drop(t_ns, MOUNT_DISAGREES)
        self.n_anew += 1
        off_deg = np.degrees(max(bent_rad, placed_rad))
        young = not self._straight
        self.forget()
        detail = f"by {off_deg:.0f} degrees, number {self.n_anew} of {MOST_ANEW} in a row"
        return Verdict(Warned(t_ns, BEGUN_ANEW, detail), reinitialise=True, young=young)

    def _drop(self, t_ns: int, what: str) -> Verdict:
        """Leave the attitude aside until turns agree again."""
        since_ns = self._agreed_ns if self._agreed_ns is not None else 0
        self.used, self._mount = False, what == MOUNT_DISAGREES
        self._not_before_ns = t_ns + self._wait_ns
        self._wait_ns = min(2 * self._wait_ns, MAX_WAIT_NS)
        self._n_held = self._n_alone = self._n_follows = 0
        self._forget_tilt()
        warning = Warned(t_ns, what, _described(self._following))
        return Verdict(warning, disowned_since_ns=since_ns, mount=self._mount)


def _described(found: Following | None) -> str:
    """What turns show, and what to look at."""
    if found is None:
        return "check how the camera is mounted, and mount.* in the configuration"
    if found.turned_mount is not None and not found.follows:
        off_deg = np.degrees(angle_between(found.turned_mount, np.eye(3)))
        return f"it sits turned by {off_deg:.0f} degrees from what is stated; check mount.*"
    gains = ", ".join(
        f"{name} {gain:.1f}"
        for name, gain in zip(("roll", "pitch", "yaw"), found.gain, strict=True)
        if np.isfinite(gain)
    )
    alone_deg = np.degrees(found.alone_rad)
    return (
        f"of the body's turns it makes this share: {gains or 'unknown'}; turned by "
        f"{alone_deg:.1f} degrees in half a second by itself; is there a gimbal?"
    )
