"""Aiding of inertial navigation from the ground up to a metric map: a place to stand on, then flow.

Velocity is optical flow times the height over the ground that the vehicle stood on, which
rangefinder, barometer and accelerometers know, as they know the vertical.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from companion.estimation.body.aiding import (
    AidedFlow,
    AidedHeight,
    AidedPlace,
    AidedRange,
    AidedRest,
)
from companion.estimation.body.body_filter import BodyFilter
from companion.estimation.lift_off.lift_off_flow import LiftOffFlow
from companion.estimation.lift_off.optical_flow import GroundVelocity
from companion.geometry.transforms import Array

STANDING_LAG_NS = 500_000_000
"""A fixed place aids inertial navigation that late: a lift-off shows so much later at most."""
SIGMA_STANDING_M, SIGMA_STANDING_M_S = 0.005, 0.02
LEGS_M, SIGMA_LEGS_M = 0.2, 0.15
"""From the ground that the vehicle stood on up to its camera."""
FLOW_EVERY_NS = 200_000_000
"""Flow aids inertial navigation so often: what it is off by stays the same for some frames."""
SIGMA_FLOW_HZ = 0.02
"""Of flow, by errors of the attitude from frame to frame: 1 mrad in 50 ms."""
STILL_HZ = 0.25
SIGMA_STILL_M_S = STILL_HZ * LEGS_M
"""Flow below it is of a vehicle that stands, and the velocity it may have on such legs. However
a camera sits, it sees nothing move there: this aids before a lift-off has shown the mount."""
USEFUL_SIGMA_M_S = 0.15
"""Of rest, by flow of nothing over the ground: by accelerometers a vehicle that touches down, and
whose map is lost there, goes on sinking (see `SHOCK_NS`)."""
HEIGHT_EVERY_NS, LEAST_HEIGHT_M = 200_000_000, 2.0
"""Lower, what the rotors blow is reflected by the ground, and presses on a barometer."""
RANGE_EVERY_NS = 100_000_000
LEAST_UPRIGHT = 0.5
"""Cosine of the body's tilt; beyond, a rangefinder looks elsewhere than down."""
UPRIGHT_NS = 500_000_000
"""The tilt of a frame says nothing of a range that much later."""
MOST_LATE = 64
"""Three wait at a time; more only where frames have ceased, and then they are of no use."""
LATE_NS = 150_000_000
"""Heights and ranges aid that long after their own time. In flight they are newer than the frame
that comes with them, and navigation knows no time before its last measurement: neither a pose of
that frame nor, half a frame earlier, the velocity that its flow is held against."""
LOW_M, LOW_NS = 1.0, 3_000_000_000
"""Height that a lift-off has risen by, or time since, before a map begins: closer than a metre most
lenses are blurred, and within it all that is seen changes its size several times. Maps that began
lower were tilted by 7 to 21 degrees a second later, where blur and noise were drawn."""
MAP_AIDED_NS = 500_000_000
"""A map that has placed the body lately makes flow needless."""


class GroundAiding:
    """Aids inertial navigation on the ground, and from a lift-off until a map has a scale."""

    def __init__(self, body: BodyFilter) -> None:
        self._body = body
        self.stood: AidedPlace | None = None
        """The fixed place while the vehicle stands, else None."""
        self.lift_off_flow = LiftOffFlow()
        """Judge of flow at the last lift-off: only flow that has shown it aids."""
        self._held: deque[AidedPlace | AidedHeight] = deque()
        """Of the latest frames while the vehicle stands; empty when it does not."""
        self._late: deque[AidedHeight | AidedRange] = deque(maxlen=MOST_LATE)
        """In flight, until a frame is newer by LATE_NS."""
        self._takes_ranges = self._takes_heights = False
        """True in flight where no map aids; for a barometer, high enough, too."""
        self._stood_down_m = 0.0
        self._lifted_ns: int | None = None
        self.low = False
        """True right after a lift-off, too low for a map, while navigation carries the pose."""
        self._upright: tuple[int, float] | None = None
        """Time of the last frame and the cosine of its tilt; None where its attitude is unknown."""
        self._height_ns = self._range_ns = self._flow_ns = 0
        self._map_aided_ns: int | None = None

    def map_aided(self, t_ns: int) -> None:
        """Take that a map with a scale has placed the body of a frame."""
        self._map_aided_ns = t_ns

    def wants_flow(self, t_ns: int) -> bool:
        """True after a lift-off, where no map has placed the body lately."""
        if self.stood is not None or not self._body.knows_ground:
            return False
        return self._map_aided_ns is None or t_ns - self._map_aided_ns > MAP_AIDED_NS

    def take_height(self, t_ns: int, height_m: float, rotors: bool) -> None:
        """Take a barometric height; where rotors turn on the ground, they press on the sensor."""
        if rotors and self.stood is not None:
            return
        if t_ns - self._height_ns < HEIGHT_EVERY_NS:
            return
        self._height_ns = t_ns
        if self.stood is not None:
            self._held.append(AidedHeight(t_ns, height_m))
        elif self._takes_heights:
            self._late.append(AidedHeight(t_ns, height_m))

    def take_range(self, t_ns: int, distance_m: float, upright: float | None = None) -> None:
        """Take the distance to the ground along the body's down axis.

        `upright` is the cosine of the body's tilt where the frames' attitude is not the body's. A
        range of a body whose tilt is unknown, or that lies on its side, says no height.
        """
        if not self._takes_ranges or t_ns - self._range_ns < RANGE_EVERY_NS:
            return
        if upright is None and self._upright is not None:
            seen_ns, of_frame = self._upright
            upright = of_frame if t_ns - seen_ns <= UPRIGHT_NS else None
        if upright is not None and upright >= LEAST_UPRIGHT:
            self._range_ns = t_ns
            self._late.append(AidedRange(t_ns, distance_m * upright))

    def stand(self, t_ns: int, place_m: Array) -> None:
        """Take a frame of a vehicle that stands: at `place_m` (3,), unless it stood before."""
        held_m = place_m if self.stood is None else self.stood.place_m
        turn = self._body.world_from_attitude
        self.stood = AidedPlace(t_ns, held_m, turn, SIGMA_STANDING_M)
        self._takes_ranges = self.low = False
        self._late.clear()
        self._held.append(self.stood)
        while self._held[0].t_ns < t_ns - STANDING_LAG_NS:
            self._body.aid(self._held.popleft())

    def fly(self, t_ns: int, down_m: float, wants: bool, upright: float | None) -> None:
        """Take a frame of a vehicle that does not stand, by autopilot stamps, at a down coordinate.

        `wants` where it is aided from here; `upright` is the cosine of its tilt, None if unknown.
        """
        if self.stood is not None:
            self._stood_down_m = float(self.stood.place_m[2])
            self._body.lift_off(self._stood_down_m + LEGS_M, SIGMA_LEGS_M)
            self.lift_off_flow, self._lifted_ns = LiftOffFlow(), t_ns
        self.stood = None
        self._held.clear()
        while self._late and self._late[0].t_ns <= t_ns - LATE_NS:
            self._body.aid(self._late.popleft())
        self._takes_ranges = wants
        self._upright = None if upright is None else (t_ns, upright)
        risen_m = self._stood_down_m - down_m
        self._takes_heights = wants and risen_m > LEAST_HEIGHT_M
        just = self._lifted_ns is not None and t_ns - self._lifted_ns < LOW_NS
        self.low = just and risen_m < LOW_M and self._body.at(t_ns) is not None

    def take_flow(self, measured: GroundVelocity, delay_ns: int) -> bool:
        """Take flow over that ground; autopilot stamps are late by `delay_ns`.

        True where it has just been found to contradict the accelerometers: the mount is wrong.
        """
        reckoned, judge = self._body.at(measured.t_ns + delay_ns), self.lift_off_flow
        if reckoned is None:
            return False
        still = float(np.linalg.norm(measured.velocity_hz)) < STILL_HZ
        if still and judge.agrees is None:
            risen_m = self._stood_down_m - float(reckoned.place_m[2])
            if risen_m < LEGS_M and self._is_due(measured):
                self._body.aid(AidedRest(measured.t_ns + delay_ns, SIGMA_STILL_M_S))
            return False
        velocity_m_s = self._body.world_from_attitude.T @ reckoned.velocity_m_s
        if judge.take(velocity_m_s, reckoned.sigma_velocity_m_s, measured):
            return True
        if not judge.agrees or not self._is_due(measured):
            return False
        covariance_hz2 = measured.covariance_hz2 + SIGMA_FLOW_HZ**2 * np.eye(3)
        if still:
            self._rest(measured, covariance_hz2, delay_ns)
        self._body.aid(AidedFlow(measured.t_ns + delay_ns, measured.velocity_hz, covariance_hz2))
        return False

    def _rest(self, measured: GroundVelocity, covariance_hz2: Array, delay_ns: int) -> None:
        """Aid by rest, to what a body may move by, as high as it may be, that shows so little."""
        height_m, sigma_m = self._body.over_ground()
        moves_hz = float(np.linalg.norm(measured.velocity_hz))
        most_hz = float(np.hypot(moves_hz, np.sqrt(np.diag(covariance_hz2).max())))
        sigma_m_s = most_hz * (max(abs(height_m), LEGS_M) + 2.0 * sigma_m)
        if sigma_m_s < USEFUL_SIGMA_M_S:
            self._body.aid(AidedRest(measured.t_ns + delay_ns, sigma_m_s))

    def _is_due(self, measured: GroundVelocity) -> bool:
        """True once in FLOW_EVERY_NS."""
        if measured.t_ns - self._flow_ns < FLOW_EVERY_NS:
            return False
        self._flow_ns = measured.t_ns
        return True
