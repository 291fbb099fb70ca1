"""Speed of the image, by what the autopilot says of the vehicle's motion."""

from __future__ import annotations

import math

import numpy as np

from companion.telemetry import AttitudeSample, ImuSample, PositionSample, RangeSample, Telemetry

OLD_NS = 1_000_000_000
"""Age above which a sample says nothing any more."""
UNKNOWN_RAD_S = 0.5
"""Angle per second by which the image is taken to turn where nothing is heard: half a radian is
what a copter turns by in a gust or a corner."""
LEAST_HEIGHT_M = 2.0
"""Nearest that the ground is taken to be where no rangefinder says so."""


class ImageSpeed:
    """Telemetry in, angle per second out. Samples come in one thread, questions in another."""

    def __init__(self) -> None:
        self._turn: tuple[int, float] | None = None
        """Time and rate of turn, rad/s; the others likewise."""
        self._speed_m_s: tuple[int, float] | None = None
        self._height_m: tuple[int, float] | None = None
        self._range_m: tuple[int, float] | None = None
        self._lowest_m = math.inf

    def take(self, sample: Telemetry) -> None:
        """Add a sample; other kinds are left aside."""
        if isinstance(sample, ImuSample):
            self._turn = sample.t_ns, float(np.linalg.norm(sample.gyro_rad_s))
        elif isinstance(sample, AttitudeSample) and sample.rates_body_rad_s is not None:
            self._turn = sample.t_ns, float(np.linalg.norm(sample.rates_body_rad_s))
        elif isinstance(sample, RangeSample):
            self._range_m = sample.t_ns, sample.distance_m
        elif isinstance(sample, PositionSample):
            up_m = -float(sample.position_ned_m[2])
            self._lowest_m = min(self._lowest_m, up_m)
            self._height_m = sample.t_ns, max(up_m - self._lowest_m, LEAST_HEIGHT_M)
            if sample.velocity_ned_m_s is not None:
                self._speed_m_s = sample.t_ns, float(np.linalg.norm(sample.velocity_ned_m_s))

    def at(self, t_ns: int) -> float:
        """Angle by which the image moves in a second at `t_ns`, rad/s: by turn and by way.

        A turn that is unknown is taken as `UNKNOWN_RAD_S`, a way that is unknown as none.
        """
        turn, speed_m_s = _recent(self._turn, t_ns), _recent(self._speed_m_s, t_ns)
        distance_m = _recent(self._range_m, t_ns) or _recent(self._height_m, t_ns)
        by_way = speed_m_s / max(distance_m, 0.1) if speed_m_s and distance_m else 0.0
        return (UNKNOWN_RAD_S if turn is None else turn) + by_way


def _recent(known: tuple[int, float] | None, t_ns: int) -> float | None:
    """The value, where it is young and a number."""
    if known is None or t_ns - known[0] > OLD_NS or not math.isfinite(known[1]):
        return None
    return known[1]
