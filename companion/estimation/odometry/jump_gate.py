"""Jump gate of the smooth odometry: whether motion can have brought the body here."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from companion.geometry.transforms import Array

MAX_ACCELERATION_M_S2 = 4.0
MIN_CONSISTENT_NS, MIN_CONSISTENT_FRAMES = 500_000_000, 3
"""Positions outside the gate are accepted, as a reset, after agreeing with each other for so long:
longer than any gap bridged (expert.feedback.max_gap_ms is at most 300), at any frame rate; and
never with fewer frames."""


class _Refused(NamedTuple):
    """Positions outside the gate since the last accepted one.

    The newest `n` of them, from `agreed_since_ns` to `t_ns`, agree with each other; the newest is
    at `position`.
    """

    since_ns: int
    agreed_since_ns: int
    t_ns: int
    position: Array
    n: int


class JumpGate:
    """Accepts positions (3,), world, metres, that differ by less than `max_jump_m` from motion."""

    def __init__(self, max_jump_m: float) -> None:
        self.max_jump_m = max_jump_m
        self._refused: _Refused | None = None

    def clear(self) -> None:
        """Forget what was refused."""
        self._refused = None

    def refused_ns(self, t_ns: int) -> int:
        """Time since when positions have been refused; 0 where none was."""
        return 0 if self._refused is None else t_ns - self._refused.since_ns

    def agree(self, position: Array, t_ns: int, velocity: Array) -> bool:
        """Add a refused position; whether enough of them agree."""
        refused = self._refused
        if refused is None or not self.reachable(
            refused.position, position, t_ns - refused.t_ns, velocity
        ):
            self._refused = _Refused(refused.since_ns if refused else t_ns, t_ns, t_ns, position, 1)
            return False
        self._refused = refused = refused._replace(t_ns=t_ns, position=position, n=refused.n + 1)
        return (
            t_ns - refused.agreed_since_ns >= MIN_CONSISTENT_NS
            and refused.n >= MIN_CONSISTENT_FRAMES
        )

    def reachable(self, before: Array, after: Array, dt_ns: int, velocity: Array) -> bool:
        """True if the body can have moved between two positions in `dt_ns`, from a velocity."""
        dt_s = dt_ns * 1e-9
        expected = before + velocity * min(dt_s, 1.0)
        away_m = float(np.linalg.norm(after - expected))
        speed = float(np.linalg.norm(velocity))
        beyond_s = max(dt_s - 1.0, 0.0)
        return away_m < self.max_jump_m + 0.5 * MAX_ACCELERATION_M_S2 * dt_s**2 + speed * beyond_s
