"""Verdict on an autopilot's velocity: whether its integral goes where the positions go.

A compass or a mount that is off turns velocity, a wrong airspeed or lens of its optical flow
stretches it; a map that takes scale and heading from it is then off by as much. Positions of the
same source say so once they have gone far enough: the integral, turned and stretched as fits best,
is to be neither.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from companion.geometry.transforms import Array
from companion.messages import Warned

EVERY_NS = 1_000_000_000
WINDOW = 120
"""Samples compared, one a second: the drift of an integrated velocity stays under a metre or two,
by Doppler of 0.1 m/s."""
LEAST = 10
MAX_GAP_NS = 3_000_000_000
"""After a longer gap the comparison begins anew: nobody knows how far the vehicle has gone."""
SIGMA_POSITION_M = 0.5
"""Of a receiver's positions against each other over two minutes, at least."""
ALLOWED = 0.03
"""Of the way, beside what the positions explain: a receiver's velocity is late by 0.1 s, say."""
SIGMAS = 3.0
PROVED = 0.15
"""A limit within which a velocity agrees with its positions, and so a map with either."""
SETTLED_NS = 10_000_000_000
"""After a change of the verdict the map is placed anew, and its first scale moves."""
N_AGREEING = 3
"""Comparisons in a row that have to say the same."""
NOT_USED = "the autopilot's velocity contradicts its positions and is not used"
USED_AGAIN = "the autopilot's velocity agrees with its positions again"


class VelocityVerdict:
    """Takes positions and integrated velocities of one source; says whether to use the latter."""

    def __init__(self) -> None:
        self.believed = True
        self._samples: deque[tuple[int, complex, complex]] = deque(maxlen=WINDOW)
        """Time, position and integral: north and east as real and imaginary part, metres."""
        self._n_other = 0
        self._settles_ns: int | None = None
        """Time until which what a map has of the velocity may be wrong; None while not known."""

    def unproved(self, t_ns: int) -> bool:
        """True where a map may still have the scale and heading of a velocity that is wrong."""
        return self._settles_ns is None or t_ns < self._settles_ns

    def take(self, t_ns: int, position_ned_m: Array, travelled_m: Array) -> Warned | None:
        """Add a position (3,) and the integral (3,) at its time; a change of the verdict."""
        if self._samples and t_ns - self._samples[-1][0] < EVERY_NS:
            return None
        if self._samples and t_ns - self._samples[-1][0] > MAX_GAP_NS:
            self._samples.clear()
        where, way = complex(*position_ned_m[:2]), complex(*travelled_m[:2])
        if not np.isfinite([where, way]).all():
            return None
        self._samples.append((t_ns, where, way))
        compared = self._compared()
        if compared is None:
            return None
        ratio, sigma = compared
        off, limit = abs(ratio - 1.0), ALLOWED + SIGMAS * sigma
        if self._settles_ns is None and off < limit < PROVED:
            self._settles_ns = t_ns
        agrees = off < limit if self.believed else off < ALLOWED
        self._n_other = 0 if agrees == self.believed else self._n_other + 1
        if self._n_other < N_AGREEING:
            return None
        self.believed, self._n_other = not self.believed, 0
        self._settles_ns = t_ns + SETTLED_NS
        turn_deg = float(np.degrees(np.angle(ratio)))
        words = f"positions go {abs(ratio):.2f} times as far, turned by {turn_deg:+.0f} degrees"
        what = USED_AGAIN if self.believed else NOT_USED
        return Warned(t_ns, what, words, good=self.believed)

    def _compared(self) -> tuple[complex, float] | None:
        """Factor from the integral to the positions, and its standard deviation.

        None where the vehicle has not moved enough to tell.
        """
        if len(self._samples) < LEAST:
            return None
        _, where, way = (np.array(each) for each in zip(*self._samples, strict=True))
        where, way = where - where.mean(), way - way.mean()
        size_m2 = float((abs(way) ** 2).mean())
        if size_m2 < SIGMA_POSITION_M**2:
            return None
        ratio = complex((way.conj() * where).mean() / size_m2)
        left_m = float(np.sqrt((abs(where - ratio * way) ** 2).mean()))
        # positions err together, for as long as it takes to go there and back: their number does
        # not make the factor more certain
        return ratio, max(left_m, SIGMA_POSITION_M) / float(np.sqrt(size_m2))
