"""Inertial navigation of the body, aided by tracked poses: what dead reckoning goes by.

Rotations are those of the autopilot, which integrates its gyroscopes itself; given them, place,
velocity, the accelerometers' bias and the tilt are linear, and a Kalman filter of these has no
point of linearisation to be wrong about (the same model finds the scale, see `inertial_scale`).
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from companion.estimation.inertial.acceleration_integral import AccelerationIntegral, Change
from companion.estimation.inertial.inertial_motion import (
    BIAS,
    PLACE,
    SIGMA_BIAS_M_S2,
    SIGMA_SPEED_M_S,
    SIGMA_TILT_M_S2,
    TILT,
    VELOCITY,
    InertialStart,
    motion,
)
from companion.geometry.transforms import Array

DOWN, GROUND, BAROMETER = PLACE.stop - 1, TILT.stop, TILT.stop + 1
"""Down coordinates, after the state of `motion`: of the ground below, of the barometer's zero."""
N_STATE = BAROMETER + 1
START = slice(VELOCITY.start, BIAS.stop)
TILT_TAU_S = 20.0
"""An autopilot's attitude is wrong otherwise after each manoeuvre."""
BIAS_WALK_M_S2 = 1e-3
"""Random walk of the bias, m/s2 per root of a second: 0.06 in an hour, by warming."""
RELIEF_M2_PER_M, RELIEF = 0.1, 0.3
"""Random walk of the height of the ground that is seen, over the way in any direction: 1 m after
10 m. Besides, its standard deviation as a ratio of the height, as houses come into sight and go."""
SIGMA_BAROMETER_M, BAROMETER_WALK_M = 0.5, 0.05
"""Of a height, with the gusts that press on the sensor; the walk of its zero with the weather and
its temperature, per root of a second: a metre in seven minutes."""
LEAST_SIGMA_PLACE_M, LEAST_SIGMA_FLOW_M_S = 0.005, 0.02
MAX_HELD_NS = 400_000_000
"""Beyond the newest acceleration, the velocity is held for at most so long."""
SIGMA_HELD_M_S2 = 3.0
"""Acceleration that may have come since."""
REFUSED = 16.3
"""Chi-square of three degrees of freedom exceeded once in a thousand times."""
NORMALISED_TAU = 30
"""Places, two seconds of them."""
MAX_REFUSED_NS = 1_000_000_000
"""Places refused for longer are believed: the filter begins anew."""


class BodyAttitude(NamedTuple):
    """Attitude `ned_from_body` (3, 3) of a frame, at its time by the autopilot's stamps."""

    t_ns: int
    ned_from_body: Array


class AidedPlace(NamedTuple):
    """A tracked place (3,) of the body, local NED, metres, and `world_from_attitude` (3, 3)."""

    t_ns: int
    place_m: Array
    world_from_attitude: Array
    sigma_m: float


class AidedFlow(NamedTuple):
    """Velocity (3,) over the height above the ground, NED by the autopilot's attitude, 1/s.

    With its covariance (3, 3), 1/s2.
    """

    t_ns: int
    velocity_hz: Array
    covariance_hz2: Array


class AidedHeight(NamedTuple):
    """A barometric height above an arbitrary level, metres, up positive."""

    t_ns: int
    height_m: float


class AidedRest(NamedTuple):
    """A body that does not move, to a standard deviation along each axis."""

    t_ns: int
    sigma_m_s: float


Aiding = AidedPlace | AidedFlow | AidedHeight | AidedRest


class Reckoned(NamedTuple):
    """Place, velocity (3,) each, local NED, metres, and their standard deviations per axis.

    `start` is what another map's scale can be found from.
    """

    place_m: Array
    velocity_m_s: Array
    sigma_place_m: float
    sigma_velocity_m_s: float
    start: InertialStart


class InertialNavigation:
    """Kalman filter of one body in a frame that changes only by what it is told.

    Places may be given before the accelerations up to their time are there: they wait.
    """

    def __init__(self, integral: AccelerationIntegral) -> None:
        self._integral = integral
        self._waiting: deque[Aiding] = deque()
        self._x, self._covariance = np.zeros(N_STATE), np.zeros((N_STATE, N_STATE))
        self._t_ns: int | None = None
        self._refused_since_ns: int | None = None
        self.world_from_attitude = np.eye(3)
        """Rotation (3, 3) from the autopilot's NED axes to those of the places."""
        self._normalised = 1.0
        """Mean squared innovation per degree of freedom, of the latest places."""
        self.n_refused = 0
        """Measurements that were refused by the innovation gate."""

    def aid(self, measured: Aiding) -> None:
        """Add what was measured, in order of time by autopilot stamps."""
        self._waiting.append(measured)
        while self._waiting and self._waiting[0].t_ns <= self._integral.newest_ns:
            first = self._waiting.popleft()
            if isinstance(first, AidedPlace):
                self._take(first)
            elif isinstance(first, AidedFlow):
                self._take_flow(first)
            elif isinstance(first, AidedRest):
                self._take_rest(first)
            else:
                self._take_height(first)
        while len(self._waiting) > 1 and (
            self._waiting[-1].t_ns - self._waiting[0].t_ns > MAX_HELD_NS
        ):
            self._waiting.popleft()  # no accelerations come

    def lift_off(self, ground_down_m: float, sigma_m: float) -> None:
        """Take the ground that the body has lifted off, at a down coordinate."""
        self._covariance[GROUND, :] = self._covariance[:, GROUND] = 0.0
        self._x[GROUND], self._covariance[GROUND, GROUND] = ground_down_m, sigma_m**2

    @property
    def knows_ground(self) -> bool:
        """True where flow over the ground is of use."""
        return self._t_ns is not None and self._covariance[GROUND, GROUND] > 0.0

    def reset(self) -> None:
        """Forget place, velocity and heights; bias and tilt are the same in another map."""
        self._t_ns = None
        for height in (GROUND, BAROMETER):
            self._covariance[height, :] = self._covariance[:, height] = 0.0
        self._waiting.clear()

    def doubt(self, sigma_m: float, sigma_m_s: float) -> None:
        """Take that what has aided it was wrong: by how much in place and velocity.

        Bias and tilt are as uncertain as at first again.
        """
        doubted = ((PLACE, sigma_m), (VELOCITY, sigma_m_s), (BIAS, SIGMA_BIAS_M_S2))
        for part, sigma in (*doubted, (TILT, SIGMA_TILT_M_S2)):
            self._covariance[part, part] += sigma**2 * np.eye(part.stop - part.start)
        self._waiting = deque(each for each in self._waiting if not isinstance(each, AidedPlace))
        self._refused_since_ns = None

    def forget(self) -> None:
        """Forget all: the accelerations were wrong."""
        self.reset()
        self._x, self._covariance = np.zeros(N_STATE), np.zeros((N_STATE, N_STATE))

    def move(self, rotation: Array, about_m: Array, to_m: Array, scale: float) -> None:
        """Change of the frame: what was at `about_m` is at `to_m`, turned and scaled about it."""
        self._x[PLACE] = to_m + scale * rotation @ (self._x[PLACE] - about_m)
        self._x[VELOCITY] = scale * rotation @ self._x[VELOCITY]
        self._x[GROUND] = to_m[2] + scale * (self._x[GROUND] - about_m[2])
        self._x[BAROMETER] += to_m[2] - about_m[2]
        self.world_from_attitude = rotation @ self.world_from_attitude
        self._waiting = deque(
            each._replace(
                place_m=to_m + scale * rotation @ (each.place_m - about_m),
                world_from_attitude=rotation @ each.world_from_attitude,
            )
            if isinstance(each, AidedPlace)
            else each
            for each in self._waiting
        )

    def at(self, t_ns: int) -> Reckoned | None:
        """Place and velocity at a time by autopilot stamps; None where not known.

        Not before the last place that was taken.
        """
        if self._t_ns is None or not self._integral.believed:
            return None
        end_ns = min(t_ns, self._integral.newest_ns)
        if t_ns - end_ns > MAX_HELD_NS or end_ns < self._t_ns:
            return None
        x, covariance = self._x, self._covariance
        if end_ns > self._t_ns:
            change = self._integral.between(self._t_ns, end_ns)
            if change is None:
                return None
            x, covariance = self._predicted(change)
        held_s = (t_ns - end_ns) * 1e-9
        # accelerations that do not fit what is seen are stated as less certain
        unlikely = max(1.0, float(np.sqrt(self._normalised)))
        sigma_v = unlikely * float(np.hypot(_sigma(covariance, VELOCITY), SIGMA_HELD_M_S2 * held_s))
        moved_m = SIGMA_HELD_M_S2 * held_s * held_s / 2.0
        sigma_p = unlikely * float(np.linalg.norm([
            _sigma(covariance, PLACE), moved_m, _sigma(covariance, VELOCITY) * held_s
        ]))  # fmt: skip
        start_covariance = unlikely**2 * covariance[START, START]
        start_covariance[:3, :3] += (SIGMA_HELD_M_S2 * held_s) ** 2 * np.eye(3)
        start = InertialStart(
            t_ns, self.world_from_attitude.T @ x[VELOCITY], x[BIAS].copy(), start_covariance
        )
        place_m = x[PLACE] + held_s * x[VELOCITY]
        return Reckoned(place_m, x[VELOCITY].copy(), sigma_p, sigma_v, start)

    def _take(self, place: AidedPlace) -> None:
        change = None
        if self._t_ns is not None and place.t_ns > self._t_ns:
            change = self._integral.between(self._t_ns, place.t_ns)
        if change is None:
            self._begin(place)
            return
        self.world_from_attitude = place.world_from_attitude
        sigma_m = max(place.sigma_m, LEAST_SIGMA_PLACE_M)
        seen = np.zeros((3, N_STATE))
        seen[:, PLACE] = np.eye(3)
        squared = self._correct(place.t_ns, change, seen, place.place_m, sigma_m**2 * np.eye(3))
        self._normalised += (squared / 3.0 - self._normalised) / NORMALISED_TAU
        if squared > REFUSED:
            since_ns = self._refused_since_ns or place.t_ns
            self._refused_since_ns = since_ns
            if place.t_ns - since_ns > MAX_REFUSED_NS:
                self._begin(place)
            return
        self._refused_since_ns = None

    def _take_flow(self, flow: AidedFlow) -> None:
        """Correct by the level part of flow; what does not fit is left out.

        Velocity is flow times height, which is of the state: the difference is linear in it. But
        heights are considered only (Schmidt 1966), not corrected: flow is a regressor, and its
        noise would make them small. The vertical part would tell little for the same reason: at a
        lift-off velocity and height are small and grow alike.
        """
        if self._t_ns is None or flow.t_ns <= self._t_ns or not self.knows_ground:
            return
        change = self._integral.between(self._t_ns, flow.t_ns)
        if change is None:
            return
        turn = self.world_from_attitude
        height_m = self._x[GROUND] - self._x[DOWN]
        if height_m <= 0.0:
            return
        seen = np.zeros((2, N_STATE))
        seen[:, VELOCITY] = np.eye(2, 3)
        seen[:, DOWN] = turn[:2] @ flow.velocity_hz
        seen[:, GROUND] = -seen[:, DOWN]
        along = RELIEF * seen[:, DOWN : DOWN + 1]
        covariance = height_m**2 * (turn[:2] @ flow.covariance_hz2 @ turn[:2].T + along @ along.T)
        covariance += LEAST_SIGMA_FLOW_M_S**2 * np.eye(2)
        self._correct(flow.t_ns, change, seen, np.zeros(2), covariance, considered=(DOWN, GROUND))

    def _take_rest(self, rest: AidedRest) -> None:
        """Correct by a velocity of nothing."""
        if self._t_ns is None or rest.t_ns <= self._t_ns:
            return
        change = self._integral.between(self._t_ns, rest.t_ns)
        if change is not None:
            seen = np.zeros((3, N_STATE))
            seen[:, VELOCITY] = np.eye(3)
            self._correct(rest.t_ns, change, seen, np.zeros(3), rest.sigma_m_s**2 * np.eye(3))

    def _take_height(self, measured: AidedHeight) -> None:
        """Correct by a barometric height; the first gives the barometer's zero."""
        if self._t_ns is None or measured.t_ns < self._t_ns:
            return
        if not self._covariance[BAROMETER, BAROMETER] > 0.0:
            self._x[BAROMETER] = self._x[DOWN] + measured.height_m
            self._covariance[BAROMETER, BAROMETER] = SIGMA_BAROMETER_M**2
            return
        change = self._integral.between(self._t_ns, measured.t_ns)
        if change is not None:
            seen = np.zeros((1, N_STATE))
            seen[0, DOWN], seen[0, BAROMETER] = -1.0, 1.0
            covariance = np.full((1, 1), SIGMA_BAROMETER_M**2)
            self._correct(measured.t_ns, change, seen, np.array([measured.height_m]), covariance)

    def _correct(
        self, t_ns: int, change: Change, seen: Array, measured: Array, covariance: Array,
        considered: tuple[int, ...] = (),
    ) -> float:  # fmt: skip
        """Correct by what was measured (M,) of `seen` (M, N) parts of the state, at a time.

        Nothing where the innovation gate refuses it; `considered` parts stay as they are. The
        squared normalised innovation.
        """
        x, spread = self._predicted(change)
        innovation = measured - seen @ x
        gained = seen @ spread
        expected = gained @ seen.T + covariance
        squared = float(innovation @ np.linalg.solve(expected, innovation))
        if squared > REFUSED:
            self.n_refused += 1
            return squared
        gain = np.linalg.solve(expected, gained).T
        if considered:
            gain[list(considered)] = 0.0
        self._x = x + gain @ innovation
        part = gain @ gained
        spread = spread - part - part.T + gain @ expected @ gain.T if considered else spread - part
        self._covariance = 0.5 * (spread + spread.T)
        self._t_ns = t_ns
        return squared

    def _begin(self, place: AidedPlace) -> None:
        """Place and velocity anew."""
        self._t_ns = place.t_ns
        self._refused_since_ns = None
        self.world_from_attitude = place.world_from_attitude
        if not self._covariance[BIAS, BIAS].any():
            self._covariance[BIAS, BIAS] = SIGMA_BIAS_M_S2**2 * np.eye(3)
            self._covariance[TILT, TILT] = SIGMA_TILT_M_S2**2 * np.eye(2)
        for part in (PLACE, VELOCITY):
            self._covariance[part, :] = self._covariance[:, part] = 0.0
        self._x[PLACE], self._x[VELOCITY] = place.place_m, 0.0
        self._covariance[PLACE, PLACE] = max(place.sigma_m, LEAST_SIGMA_PLACE_M) ** 2 * np.eye(3)
        self._covariance[VELOCITY, VELOCITY] = SIGMA_SPEED_M_S**2 * np.eye(3)

    def _predicted(self, change: Change) -> tuple[Array, Array]:
        """State and covariance after a change of motion that accelerometers measured."""
        density = self._integral.density_m_s2
        found = motion(change, self.world_from_attitude, density, TILT_TAU_S, N_STATE)
        x = found.step @ self._x
        x[PLACE] += found.moved_m
        x[VELOCITY] += found.gained_m_s
        covariance = found.step @ self._covariance @ found.step.T + found.noise
        covariance[BIAS, BIAS] += BIAS_WALK_M_S2**2 * change.dt_s * np.eye(3)
        if covariance[BAROMETER, BAROMETER] > 0.0:
            covariance[BAROMETER, BAROMETER] += BAROMETER_WALK_M**2 * change.dt_s
        if covariance[GROUND, GROUND] > 0.0:
            way_m = float(np.linalg.norm(x[PLACE] - self._x[PLACE]))
            covariance[GROUND, GROUND] += RELIEF_M2_PER_M * way_m
        return x, covariance


def _sigma(covariance: Array, part: slice) -> float:
    """The largest standard deviation along an axis."""
    return float(np.sqrt(max(np.diag(covariance)[part].max(), 0.0)))
