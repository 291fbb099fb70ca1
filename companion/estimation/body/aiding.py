"""Measurements that aid the body's filter, each as a linear one of its state."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

import numpy as np

from companion.estimation.body.body_state import BAROMETER, DOWN, GROUND, N_STATE, BodyState
from companion.estimation.inertial.inertial_motion import PLACE, VELOCITY
from companion.geometry.transforms import Array

RELIEF = 0.3
"""Standard deviation of the height of the ground that is seen, as a ratio of the height: houses
come into sight and go."""
SIGMA_BAROMETER_M = 0.5
"""Of a height, with the gusts that press on the sensor."""
CLIMB_HEIGHT_M = 2.0
"""Height over the ground from which flow tells the climb, too: at a lift-off velocity and height
are small and grow alike."""
LEAST_SIGMA_PLACE_M, LEAST_SIGMA_FLOW_M_S = 0.005, 0.02
SIGMA_RANGE_M, SIGMA_RANGE_RATIO = 0.1, 0.03
"""Of a rangefinder, which sits elsewhere on the body than the camera, over grass and stones."""


class Aid(Enum):
    """Kinds of measurements."""

    PLACE = "place"
    FLOW = "flow"
    HEIGHT = "height"
    RANGE = "range"
    REST = "rest"


class AidedPlace(NamedTuple):
    """A tracked place (3,) of the body, local NED, metres, and `world_from_attitude` (3, 3).

    The first in a map has the standard deviation of the map's scale: it says where that lies, and
    nothing of where the body has gone.
    """

    t_ns: int
    place_m: Array
    world_from_attitude: Array
    sigma_m: float
    sigma_scale: float | None = None

    def moved(self, rotation: Array, about_m: Array, to_m: Array, scale: float) -> AidedPlace:
        """The same in another frame; see `BodyState.moved`."""
        return self._replace(
            place_m=to_m + scale * rotation @ (self.place_m - about_m),
            world_from_attitude=rotation @ self.world_from_attitude,
        )


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


class AidedRange(NamedTuple):
    """Height of the body above the ground below it, metres, by a rangefinder."""

    t_ns: int
    height_m: float


class AidedRest(NamedTuple):
    """A body that does not move, to a standard deviation along each axis."""

    t_ns: int
    sigma_m_s: float


Aiding = AidedPlace | AidedFlow | AidedHeight | AidedRange | AidedRest


class Model(NamedTuple):
    """Measurement (M,) of `seen` (M, N) parts of the state, with its covariance (M, M).

    `considered` parts are not corrected by it.
    """

    kind: Aid
    seen: Array
    measured: Array
    covariance: Array
    considered: tuple[int, ...] = ()


def model_of(measured: Aiding, state: BodyState) -> Model | None:
    """Model of a measurement at the time of a state; None where the state lacks what it is of."""
    if isinstance(measured, AidedPlace):
        seen = np.zeros((3, N_STATE))
        seen[:, PLACE] = np.eye(3)
        variance = max(measured.sigma_m, LEAST_SIGMA_PLACE_M) ** 2 * np.eye(3)
        return Model(Aid.PLACE, seen, measured.place_m, variance)
    if isinstance(measured, AidedRest):
        seen = np.zeros((3, N_STATE))
        seen[:, VELOCITY] = np.eye(3)
        return Model(Aid.REST, seen, np.zeros(3), measured.sigma_m_s**2 * np.eye(3))
    if isinstance(measured, AidedHeight):
        if not state.covariance[BAROMETER, BAROMETER] > 0.0:
            return None
        seen = np.zeros((1, N_STATE))
        seen[0, DOWN], seen[0, BAROMETER] = -1.0, 1.0
        variance = np.full((1, 1), SIGMA_BAROMETER_M**2)
        return Model(Aid.HEIGHT, seen, np.array([measured.height_m]), variance)
    if isinstance(measured, AidedRange):
        return _range_model(measured, state)
    return _flow_model(measured, state)


def _range_model(measured: AidedRange, state: BodyState) -> Model | None:
    """The height above a ground that walks by its relief: it learns of the body and of the ground.

    None where no ground is known: nothing tells yet that what is below the body is what it sees.
    """
    if not state.covariance[GROUND, GROUND] > 0.0:
        return None
    seen = np.zeros((1, N_STATE))
    seen[0, GROUND], seen[0, DOWN] = 1.0, -1.0
    variance = SIGMA_RANGE_M**2 + (SIGMA_RANGE_RATIO * measured.height_m) ** 2
    return Model(Aid.RANGE, seen, np.array([measured.height_m]), np.full((1, 1), variance))


def _flow_model(flow: AidedFlow, state: BodyState) -> Model | None:
    """Flow: its level part, and high enough its vertical one.

    Velocity is flow times height, which is of the state: the difference is linear in it. But
    heights are considered only (Schmidt 1966), not corrected: flow is a regressor, and its noise
    would make them small.
    """
    height_m = state.mean[GROUND] - state.mean[DOWN]
    if not state.covariance[GROUND, GROUND] > 0.0 or height_m <= 0.0:
        return None
    n = 3 if height_m > CLIMB_HEIGHT_M else 2
    turn = state.world_from_attitude[:n]
    seen = np.zeros((n, N_STATE))
    seen[:, VELOCITY] = np.eye(n, 3)
    seen[:, DOWN] = turn @ flow.velocity_hz
    seen[:, GROUND] = -seen[:, DOWN]
    along = RELIEF * seen[:, DOWN : DOWN + 1]
    variance = height_m**2 * (turn @ flow.covariance_hz2 @ turn.T + along @ along.T)
    variance += LEAST_SIGMA_FLOW_M_S**2 * np.eye(n)
    return Model(Aid.FLOW, seen, np.zeros(n), variance, considered=(DOWN, GROUND))
