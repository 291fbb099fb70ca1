"""Gate of the landing marker: positions that an autopilot may be sent.

A position is let through where it is of now, certain, below the vehicle, on a face that lies level
by the autopilot's attitude, and where the frames before it saw the marker there, too. A poster on a
wall, a square that happens to have the code and a camera that does not turn with the body are
refused by these. Nothing is predicted: without a marker nothing is sent, and the autopilot sees
that it is not.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from companion.config import MEASUREMENTS, Measurement
from companion.estimation.attitude.attitude_history import AttitudeHistory
from companion.geometry.transforms import Array
from companion.messages import LandingTarget
from companion.telemetry import AttitudeSample, is_believed

MAX_AGE_NS = 200_000_000
"""An older position is not sent: at 1 m/s the vehicle is 0.2 m further on."""
MAX_SIGMA_M = 0.3
"""Largest standard deviation along a level axis: twice the error that a landing may have."""
MAX_TILT_COS = float(np.cos(np.radians(25.0)))
"""Cosine of the largest angle of the marker's face to the level: that of an attitude, of a pose of
a small marker, and of the ground together."""
PROOF, PROOF_NS = 3, 1_000_000_000
"""Frames in a row that must agree before one is sent, and the longest time between two of them."""
MAX_SPEED_M_S = 15.0
"""Speed of the vehicle against the marker beyond which two positions are not of one marker."""

NO_ATTITUDE, NOT_BELIEVED = "no autopilot attitude", "attitude is not believed"
STALE, UNCERTAIN, ABOVE, NOT_LEVEL, UNPROVEN = (
    "too old", "too far", "not below", "does not lie level", "being checked",
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class TargetToSend:
    """Centre of the marker from the body: (3,) in body axes, and in those of NED; metres."""

    t_ns: int
    position_body_m: Array
    offset_ned_m: Array

    @property
    def distance_m(self) -> float:
        """Distance of the marker from the body."""
        return float(np.linalg.norm(self.position_body_m))


class LandingGate:
    """Decides frame by frame; `why_not` is the reason of the last refusal, "" without one."""

    def __init__(self, use: Collection[Measurement] = MEASUREMENTS) -> None:
        self._use = use
        self._attitude = AttitudeHistory(keep=500)
        self._before: tuple[int, Array, Array] | None = None
        """Time, offset in NED and its standard deviations, of the frame before."""
        self._n_agreeing = 0
        self.why_not = ""

    def take_attitude(self, sample: AttitudeSample) -> None:
        """Take an attitude of the autopilot."""
        if is_believed(sample, self._use):
            self._attitude.add(sample)

    def take(self, target: LandingTarget, now_ns: int) -> TargetToSend | None:
        """The position to send of a frame, at the time of the call; None with `why_not`."""
        found, self.why_not = self._checked(target, now_ns)
        if found is None:
            self._restart()
            return None
        assert target.sigma_body_m is not None
        # any axis of the body may be the level one
        sigma = np.full(3, float(target.sigma_body_m.max()))
        before, self._before = self._before, (target.t_ns, found.offset_ned_m, sigma)
        agrees = before is not None and _agree(before, self._before)
        self._n_agreeing = self._n_agreeing + 1 if agrees else 1
        if self._n_agreeing < PROOF:
            self.why_not = UNPROVEN
            return None
        return found

    def _checked(self, target: LandingTarget, now_ns: int) -> tuple[TargetToSend | None, str]:
        """The position, by this frame alone, or why it is refused."""
        position, sigma, normals = (
            target.position_body_m, target.sigma_body_m, target.normals_body,
        )  # fmt: skip
        if position is None or sigma is None or normals is None:
            return None, target.why_not
        if "attitude" not in self._use:
            return None, NOT_BELIEVED
        if now_ns - target.t_ns > MAX_AGE_NS:
            return None, STALE
        ned_from_body = self._attitude.at(target.t_ns)
        if ned_from_body is None:
            return None, NO_ATTITUDE
        offset = ned_from_body @ position
        level = np.linalg.norm((ned_from_body * sigma)[:2], axis=1)
        if not level.max() <= MAX_SIGMA_M:
            return None, UNCERTAIN
        if offset[2] <= 0.0:
            return None, ABOVE
        if not (normals @ -ned_from_body[2]).max() >= MAX_TILT_COS:
            return None, NOT_LEVEL
        return TargetToSend(target.t_ns, position, offset), ""

    def _restart(self) -> None:
        self._before, self._n_agreeing = None, 0


def _agree(before: tuple[int, Array, Array], now: tuple[int, Array, Array]) -> bool:
    """True if two positions are of one marker, of frames that follow each other."""
    dt_ns = now[0] - before[0]
    if not 0 < dt_ns <= PROOF_NS:
        return False
    may_be_m = MAX_SPEED_M_S * 1e-9 * dt_ns + 3.0 * float(np.hypot(before[2], now[2]).max())
    return float(np.linalg.norm(now[1] - before[1])) <= may_be_m
