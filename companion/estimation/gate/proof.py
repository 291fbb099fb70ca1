"""Proof of poses: for how long the rules must be kept before the first is sent, and again.

A pause casts doubt on a pose that goes on by what may have happened in it: two frames lost at 10
frames/s are no reason to withhold a second of good ones. Of a pose that only could not be checked,
or that dead reckoning has foretold, there is hardly any; nor of one in a map that has been verified
after a restart.
"""

from __future__ import annotations

import numpy as np

from companion.estimation.body.limits import CONTRADICTS_SIGMAS
from companion.estimation.gate.pose_rules import NO_ATTITUDE
from companion.messages import Odometry

SILENT = "no frames"
FORETOLD = "foretold"
MAP_RESUMED = "map resumed after restart"
"""Said by localisation once it has verified the map of a process that was killed."""
BRIEF_NS = 300_000_000
"""Six frames of 20 a second. A vehicle without a pose is off by a metre within two seconds."""
MAX_PAUSE_NS = 3_000_000_000
"""After frames that came too late, dead reckoning begins again within this time, with proof: a
computer that was busy for a moment has lost nothing of where the body is."""
MAX_BETWEEN_NS = 500_000_000
"""Dead reckoning tells where the body is in a frame so much later."""


class Proof:
    """State of a proof; times are those of each call."""

    def __init__(self) -> None:
        self._since_ns: int | None = None
        self._ceased = ""
        """Reason for which poses ceased, where no frame was refused for another since."""
        self._silent_since_ns: int | None = None

    def begin_anew(self, ceased: str = "", silent_since_ns: int | None = None) -> None:
        """Begin anew; `ceased` says why poses did, where that may shorten it."""
        self._since_ns, self._ceased, self._silent_since_ns = None, ceased, silent_since_ns

    def foretell(self) -> None:
        """Take that poses go on where they were known to, without a doubt."""
        self._ceased = FORETOLD

    def interrupt(self) -> None:
        """Take that no pose has kept the rules for too long."""
        if self._since_ns is not None and self._ceased != SILENT:
            self._ceased = ""
        self._since_ns = None

    def refuse(self, why_not: str) -> None:
        """Take that a pose has broken a rule."""
        self._since_ns = None
        if why_not != self._ceased:
            self._ceased = ""

    def keep(self, now_ns: int, whole_ns: int, as_reckoned: bool) -> bool:
        """Take a pose that keeps the rules; whether they have been kept for long enough."""
        if self._since_ns is None:
            self._since_ns = now_ns
        if as_reckoned:
            self.foretell()
        if self._ceased in (NO_ATTITUDE, FORETOLD):
            whole_ns = min(whole_ns, BRIEF_NS)
        elif self._ceased == SILENT and self._silent_since_ns is not None:
            whole_ns = min(whole_ns, self._since_ns - self._silent_since_ns)
        return now_ns - self._since_ns >= whole_ns

    def paused_lately(self, now_ns: int) -> bool:
        """True where poses ceased for want of frames alone, and not long ago."""
        since_ns = self._silent_since_ns
        return since_ns is not None and now_ns - since_ns < MAX_PAUSE_NS


def seen_as_reckoned(before: Odometry, now: Odometry) -> bool:
    """True where a frame is tracked after dead reckoning, and no further off than that may be."""
    reckoned, seen = before.world_from_body, now.world_from_body
    velocity, dt_ns = before.velocity_world_m_s, now.t_ns - before.t_ns
    if not before.inertial or now.inertial or dt_ns > MAX_BETWEEN_NS:
        return False
    if reckoned is None or seen is None or velocity is None:
        return False
    expected = reckoned.translation + velocity * (dt_ns * 1e-9)
    off_m = float(np.linalg.norm(seen.translation - expected))
    return off_m < CONTRADICTS_SIGMAS * before.sigma_position_m
