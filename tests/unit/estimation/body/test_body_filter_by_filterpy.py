"""The body's filter, where no accelerations are measured, against a Kalman filter by filterpy."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter

from companion.estimation.body.aiding import AidedPlace, AidedRest
from companion.estimation.body.body_filter import NORMALISED_TAU, BodyFilter
from companion.estimation.body.body_state import UNMEASURED_M_S2
from companion.estimation.body.gated_correction import CHI_SQUARE_LIMIT
from companion.estimation.inertial.acceleration_integral import AccelerationIntegral
from companion.estimation.inertial.inertial_motion import SIGMA_SPEED_M_S
from companion.geometry.transforms import Array

INTERVAL_S, SIGMA_M, SIGMA_REST_M_S = 0.07, 0.03, 0.02
OUTLIER, RESTED = 23, 31
"""Numbers of the place that lies elsewhere, and of the one after which the body rests."""


def reference(place_m: Array) -> KalmanFilter:
    """Place and velocity (6,), held, as known with the first place."""
    found = KalmanFilter(dim_x=6, dim_z=3)
    found.x = np.r_[place_m, np.zeros(3)]
    found.P = np.diag(np.repeat([SIGMA_M, SIGMA_SPEED_M_S], 3) ** 2)
    found.F = np.kron([[1.0, INTERVAL_S], [0.0, 1.0]], np.eye(3))
    walk = [[INTERVAL_S**3 / 3, INTERVAL_S**2 / 2], [INTERVAL_S**2 / 2, INTERVAL_S]]
    found.Q = UNMEASURED_M_S2**2 * np.kron(walk, np.eye(3))
    return found


def take(found: KalmanFilter, measured: Array, part: int, sigma: float) -> float:
    """Correct place (part 0) or velocity (1) unless it is refused; its squared innovation.

    That is at most what the gate lets pass.
    """
    seen = np.eye(6)[3 * part : 3 * part + 3]
    spread = seen @ found.P @ seen.T + sigma**2 * np.eye(3)
    innovation = measured - seen @ found.x
    squared = float(innovation @ np.linalg.solve(spread, innovation))
    if squared <= CHI_SQUARE_LIMIT[3]:
        found.update(measured, R=sigma**2 * np.eye(3), H=seen)
    return min(squared, CHI_SQUARE_LIMIT[3])


def test_it_is_the_kalman_filter_of_its_model(rng: np.random.Generator) -> None:
    def place_m(n: int) -> Array:
        t_s = n * INTERVAL_S
        at = np.array([3.0 * np.sin(t_s), 2.0 * t_s, -5.0 - 0.3 * t_s])
        return at + rng.normal(scale=SIGMA_M, size=3) + (4.0 if n == OUTLIER else 0.0)

    ours = BodyFilter(AccelerationIntegral())
    theirs, normalised = None, 1.0
    for n in range(40):
        t_ns, at_m = round(n * INTERVAL_S * 1e9), place_m(n)
        ours.aid(AidedPlace(t_ns, at_m, np.eye(3), SIGMA_M))
        if theirs is None:
            theirs = reference(at_m)
        else:
            theirs.predict()
            squared = take(theirs, at_m, 0, SIGMA_M)
            normalised += (squared / 3.0 - normalised) / NORMALISED_TAU
        if n == RESTED:
            ours.aid(AidedRest(t_ns, SIGMA_REST_M_S))
            take(theirs, np.zeros(3), 1, SIGMA_REST_M_S)
        found = ours.moving(t_ns)
        assert found is not None
        np.testing.assert_allclose(found.place_m, theirs.x[:3], atol=1e-9)
        np.testing.assert_allclose(found.velocity_m_s, theirs.x[3:], atol=1e-9)
        sigmas = max(1.0, normalised) ** 0.5 * np.sqrt(np.diag(theirs.P))
        assert found.sigma_place_m == pytest.approx(sigmas[:3].max(), rel=1e-6)
        assert found.sigma_velocity_m_s == pytest.approx(sigmas[3:].max(), rel=1e-6)
    assert ours.n_refused["place"] == 1
