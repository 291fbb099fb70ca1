"""Verdict on satellites: whether a receiver's positions go where vision goes.

What is found is a change of the difference between both over a window, in position, velocity and
height, against the standard deviations of both: a jump at once, a slow pull within seconds, a
position that stands while the vehicle moves, a track that is turned, a receiver that has gone
silent. While satellites are doubted no position of the autopilot places the map: its own estimate
follows them. They are used again once the difference is what it was before, but for what vision
may have drifted by since; a position that stays elsewhere stays doubted.

Where vision fails right after it has accused satellites, it was the one that was wrong: the doubt
is withdrawn. Should vision come back where it was and still contradict them, they are doubted anew.
"""

from __future__ import annotations

from collections import deque
from enum import Enum

import numpy as np

from companion.estimation.satellites.satellite_residuals import (
    PATH,
    RATE_M_S,
    WHITE_M,
    Change,
    SatelliteResiduals,
)
from companion.geometry.transforms import Array, Pose
from companion.messages import Georeference, Warned
from companion.telemetry import PositionSample, PositionSource

SIGMAS = 3.8
"""Change that is doubted, in standard deviations. They are stated amply: see `RATE_M_S`."""
SPEED_SIGMAS, WITH_SPEED_SIGMAS = 3.0, 2.2
"""The same of a velocity, and of the position that then must go the same way."""
ALONG = 0.8
"""Cosine of the angle between both."""
JUMP_SIGMAS, JUMP_M, JUMP_UP_M = 7.0, 4.0, 8.0
"""Change from one position to the next that is a jump; receivers correct themselves by a metre or
two."""
N_JUMPED, N_MOVED = 2, 2
"""Positions in a row that must say so: single ones are left out without a word."""
TURNED_RAD, LENGTH_RATIO, TURNED_M = np.radians(20.0), 0.15, 8.0
"""A track that is turned by more, and as long as vision's within the second, over this way."""
GONE_NS, N_KNOWN, HEARD_NS = 3_000_000_000, 10, 500_000_000
"""Without any position for so long, after so many, satellites are gone, where the autopilot was
heard all the time, without longer gaps than the last."""
GONE_INTERVALS = 4
"""And for so many of the longest of the last intervals: slow links carry one in some seconds."""
POOR_M = 10.0
"""Stated standard deviation of a position that is none."""
ANCHOR_S = 10.0
"""Longest time before a doubt at which satellites were where they should be."""
AGAIN_S = 5.0
"""For so long satellites must agree before they are used again."""
AGAIN_M = 2.0
"""Difference from before that is no difference."""
AGAIN_SIGMAS = 4.0
WANDER_S = 60.0
"""For so long errors of a receiver wander away; they are bounded."""
FREE_S = 30.0
"""Without the map of before nobody knows where satellites should be: then they are used again after
this long, if they go where vision goes, or if there is none: a map needs them for its place."""
SETTLED_S = 10.0
"""Time for which a map has been placed before it is held against anything: its first scale is by a
few positions, and moves by more than is stated."""
ACCUSED_S, LOST_S = 3.0, 0.5
"""Vision that is lost for the second had gone astray within the first before: by the shorter of the
windows, which its fault is found by."""


class Doubt(Enum):
    """Reasons to doubt satellites: what a `Warned` says."""

    JUMP = "satellite positions jump and are not used"
    PULL = "satellite positions drift away from vision and are not used"
    HEIGHT = "satellite height drifts away from vision and is not used"
    STANDS = "satellite positions stand still and are not used"
    TURNED = "satellite positions go another way than vision and are not used"
    GONE = "no satellite positions any more"
    POOR = "satellite positions are too inaccurate and are not used"


BY_VISION = (Doubt.PULL, Doubt.HEIGHT, Doubt.TURNED)
"""For which vision is the only witness: what jumps or stands shows in the positions themselves."""
USED_AGAIN = "satellite positions agree with vision again and are used"
WITHDRAWN = "vision failed after it had contradicted satellite positions: they are used"


class SatelliteWatch:
    """Takes poses of vision and positions of satellites, in order of time.

    Without `calibrated` vision is held against nothing: a lens or a mount that was guessed bends
    its path. Satellites that fall silent are said all the same.
    """

    def __init__(self, camera_from_body: Pose, calibrated: bool = True) -> None:
        self._calibrated = calibrated
        self._residuals = SatelliteResiduals(camera_from_body)
        self._doubt: Doubt | None = None
        self._map_id: int | None = None
        self._n_jumped = self._n_moved = self._n_seen = 0
        self._anchor: Array | None = None
        """Residual (3,) before the doubt began; None where that map is gone."""
        self._anchor_path_m = self._doubt_s = self._agrees_since_s = 0.0
        self._apart_since_s = 0.0
        """Begin of the window over which satellites had moved away from vision."""
        self._tracked_s = 0.0
        self._lost_since_s: float | None = None
        self._was_judged = True
        """True if the newest position was held against vision."""
        self._newest_ns = self._heard_ns = 0
        self._intervals_ns: deque[int] = deque(maxlen=N_KNOWN)
        self._warnings: list[Warned] = []

    @property
    def doubted(self) -> bool:
        """True while satellites are not used."""
        return self._doubt is not None

    def changes(self) -> list[Change]:
        """Changes over windows up to the newest position, for figures."""
        return self._residuals.changes()

    def warnings(self) -> list[Warned]:
        """Changes of the verdict since the last call."""
        out, self._warnings = self._warnings, []
        return out

    def take_frame(
        self, t_ns: int, map_id: int, map_from_camera: Pose | None, placed: Georeference | None,
        near_limits: bool = False,
    ) -> None:  # fmt: skip
        """Take the pose of a frame, None where it is lost, with the place of its map if known.

        `near_limits` where tracking may fail.
        """
        t_s = 1e-9 * t_ns
        other_map = map_from_camera is not None and map_id != self._map_id
        if map_from_camera is None and self._lost_since_s is None:
            self._lost_since_s = t_s
        if self._lost_since_s is not None and (other_map or t_s - self._lost_since_s >= LOST_S):
            self._withdraw(t_ns)
        if map_from_camera is None:
            return
        if other_map:
            self._map_id, self._anchor = map_id, None
        self._tracked_s, self._lost_since_s = t_s, None
        self._residuals.take_pose(t_ns, map_id, map_from_camera, placed, near_limits)

    def _withdraw(self, t_ns: int) -> None:
        """End a doubt of which vision that has failed is the only witness."""
        if self._doubt in BY_VISION and self._doubt_s >= self._tracked_s - ACCUSED_S:
            self._residuals.keep_until(self._apart_since_s)
            self._end(t_ns, WITHDRAWN)

    def take_time(self, t_ns: int) -> None:
        """The autopilot is heard at this time: satellites may have gone silent."""
        if t_ns - self._heard_ns > HEARD_NS:
            self._newest_ns = max(self._newest_ns, t_ns)
        self._heard_ns = t_ns
        if self._n_seen >= N_KNOWN and self._doubt is None:
            wait_ns = max(GONE_NS, GONE_INTERVALS * max(self._intervals_ns))
            if t_ns - self._newest_ns > wait_ns:
                self._begin(t_ns, Doubt.GONE, self._residuals.offset_m(3.0), "")

    def may_use(self, sample: PositionSample, velocity_unproved: bool = False) -> bool:
        """True if a position may place the map.

        `velocity_unproved` where that may be of an autopilot's velocity that is wrong.
        """
        self._residuals.velocity_unproved = velocity_unproved
        if sample.source is not PositionSource.GPS:  # the autopilot goes on by other sensors
            return self._doubt in (None, Doubt.GONE)
        if self._doubt is not Doubt.GONE:
            self._intervals_ns.append(sample.t_ns - self._newest_ns if self._newest_ns else 0)
        self._newest_ns, self._n_seen = sample.t_ns, self._n_seen + 1
        stated_m = sample.sigma_horizontal_m
        if stated_m is not None and stated_m > POOR_M:
            if self._doubt is None and self._n_seen >= N_KNOWN:
                anchor = self._residuals.offset_m(3.0)
                self._begin(sample.t_ns, Doubt.POOR, anchor, f"{stated_m:.0f} m are stated")
            self._agrees_since_s = 0.0
            return not self.doubted
        judged = self._residuals.take_position(sample) and self._settled(sample.t_ns)
        if self._doubt is not None:
            self._look_for_end(sample.t_ns, judged)
        elif judged:
            if self._jumped(sample.t_ns):
                return False
            self._compare(sample.t_ns)
        return not self.doubted

    def _settled(self, t_ns: int) -> bool:
        """True if satellites can be held against the map."""
        since_s = self._residuals.placed_since_s
        return self._calibrated and since_s is not None and 1e-9 * t_ns - since_s >= SETTLED_S

    def _jumped(self, t_ns: int) -> bool:
        """True if the newest position is elsewhere than those of the second before."""
        jump = self._residuals.newest_jump()
        if jump is None:
            self._n_jumped = 0
            return False
        moved, sigma_m, sigma_up_m = jump
        off_m = float(np.hypot(*moved[:2]))
        far = off_m > max(JUMP_M, JUMP_SIGMAS * sigma_m)
        high = abs(moved[2]) > max(JUMP_UP_M, JUMP_SIGMAS * sigma_up_m)
        if not (far or high):
            self._n_jumped = 0
            return False
        self._residuals.drop_newest()
        self._n_jumped += 1
        if self._n_jumped >= N_JUMPED:
            detail = f"by {off_m:.0f} m, {-moved[2]:+.0f} m up"
            self._begin(t_ns, Doubt.JUMP, self._residuals.offset_m(3.0), detail)
        return True

    def _compare(self, t_ns: int) -> None:
        """Doubt what has moved away over any of the windows."""
        changes = self._residuals.changes()
        found = next(filter(None, map(_doubt_of, changes)), None)
        self._n_moved = 0 if found is None else self._n_moved + 1
        if found is not None and self._n_moved >= N_MOVED:
            doubt, change, detail = found
            # of a slow change the beginning of a short window is off, too
            longer = [c.base_m for c in changes if change.window_s <= c.window_s <= ANCHOR_S]
            self._begin(t_ns, doubt, [change.base_m, *longer][-1], detail)
            self._apart_since_s = self._doubt_s - change.window_s

    def _begin(self, t_ns: int, doubt: Doubt, anchor: Array | None, detail: str) -> None:
        self._doubt, self._anchor = doubt, anchor if self._settled(t_ns) else None
        self._anchor_path_m, self._doubt_s = self._residuals.path_m, 1e-9 * t_ns
        self._agrees_since_s = 0.0
        self._n_jumped = self._n_moved = 0
        self._warnings.append(Warned(t_ns, doubt.value, detail))

    def _agrees(self, t_ns: int) -> bool:
        """True if satellites go where vision goes, and are where they were before the doubt."""
        offset = self._residuals.offset_m(1.0)
        recent = [c for c in self._residuals.changes() if c.window_s <= AGAIN_S]
        if offset is None or any(map(_doubt_of, recent)):
            return False
        if self._anchor is None:
            return True
        off_m = float(np.hypot(*(offset - self._anchor)[:2]))
        since_m = self._residuals.path_m - self._anchor_path_m
        wandered_s = min(1e-9 * t_ns - self._doubt_s, WANDER_S)
        sigma_m = float(
            np.linalg.norm([WHITE_M[0], 2 * PATH * since_m, RATE_M_S[0] * wandered_s / 4])
        )
        return off_m < max(AGAIN_M, AGAIN_SIGMAS * sigma_m)

    def _look_for_end(self, t_ns: int, judged: bool) -> None:
        """End a doubt once nothing has contradicted satellites for long enough.

        Those that were only gone, and that nothing is known of, are used at once.
        """
        t_s = 1e-9 * t_ns
        if judged is not self._was_judged:  # counted anew by another measure
            self._was_judged, self._agrees_since_s = judged, 0.0
        if judged and not self._agrees(t_ns):
            self._agrees_since_s = 0.0
            return
        self._agrees_since_s = self._agrees_since_s or t_s
        wait_s = AGAIN_S if judged and self._anchor is not None else FREE_S
        if self._anchor is None and self._doubt in (Doubt.GONE, Doubt.POOR):
            wait_s = 0.0 if self._doubt is Doubt.GONE else AGAIN_S
        if t_s - self._agrees_since_s >= wait_s:
            self._residuals.keep_since(self._agrees_since_s)
            self._end(t_ns, USED_AGAIN)

    def _end(self, t_ns: int, what: str) -> None:
        """Satellites are used from now on."""
        self._doubt = None
        detail = f"after {1e-9 * t_ns - self._doubt_s:.0f} s"
        self._warnings.append(Warned(t_ns, what, detail, good=True))


def _doubt_of(change: Change) -> tuple[Doubt, Change, str] | None:
    """Reason to doubt a change over a window; None without one."""
    off_m = float(np.hypot(*change.horizontal_m))
    sigmas = off_m / change.sigma_horizontal_m
    speed_m_s = float(np.hypot(*change.speed_m_s))
    with_speed = (
        speed_m_s > SPEED_SIGMAS * change.sigma_speed_m_s
        and sigmas > WITH_SPEED_SIGMAS
        and float(change.speed_m_s @ change.horizontal_m) > ALONG * speed_m_s * off_m
    )
    if sigmas > SIGMAS or with_speed:
        return _named(change, off_m)
    if abs(change.vertical_m) > SIGMAS * change.sigma_vertical_m:
        return Doubt.HEIGHT, change, f"by {-change.vertical_m:+.1f} m in {change.window_s:.0f} s"
    return None


def _named(change: Change, off_m: float) -> tuple[Doubt, Change, str]:
    """Kind of a change in the horizontal."""
    if change.gps_stands:
        return Doubt.STANDS, change, f"by {off_m:.1f} m in {change.window_s:.0f} s"
    flown = complex(*change.flown_m[:2])
    if abs(flown) > TURNED_M:
        gone = (flown + complex(*change.horizontal_m)) / flown
        turned_rad = float(np.angle(gone))
        if abs(turned_rad) > TURNED_RAD and abs(abs(gone) - 1.0) < LENGTH_RATIO:
            return Doubt.TURNED, change, f"turned by {np.degrees(turned_rad):+.0f} degrees"
    return Doubt.PULL, change, f"by {off_m:.1f} m in {change.window_s:.0f} s"


def doubts(warning: Warned) -> bool | None:
    """True where a warning begins a doubt, False where it ends one; None for any other."""
    if warning.what in (USED_AGAIN, WITHDRAWN):
        return False
    return True if any(warning.what == doubt.value for doubt in Doubt) else None
