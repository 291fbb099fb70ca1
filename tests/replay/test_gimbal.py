"""Flights with a gimbal: the body is posed as with a fixed camera, and not while angles lie."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from companion.estimation.attitude.attitude_verdict import GIMBAL_DISAGREES
from companion.estimation.gimbal.gimbal_head import GIMBAL_HEARD, GIMBAL_SILENT
from companion.telemetry import GimbalSample
from tests.support.flights.gimbal_flight import Mode, body_errors, fly_with_gimbal
from tests.support.flights.rendered_flight import START_NS, Flown

LIES_S, BACK_S, SECONDS = 4.5, 6.5, 8.0


def known_s(flown: Flown) -> np.ndarray:
    """Times of poses of the body, seconds since the start."""
    known = [o.t_ns for o in flown.odometry if o.world_from_body is not None]
    return (np.array(known) - START_NS) * 1e-9


def warned_s(flown: Flown, what: str) -> list[float]:
    return [(t_ns - START_NS) * 1e-9 for t_ns, each in flown.warned if each == what]


def test_the_body_is_followed_and_given_out_while_the_gimbal_speaks() -> None:
    def silent(after_s: float, sample: GimbalSample) -> GimbalSample | None:
        return None if LIES_S < after_s < BACK_S else sample

    flown = fly_with_gimbal(Mode.FOLLOW, SECONDS, silent)
    away_m, turn_rad = body_errors(flown.odometry)
    assert flown.placed_share > 0.98
    # the autopilot's attitude is off by 0.7 degrees, its positions wander by decimetres
    assert np.sqrt((away_m**2).sum(1).mean()) < 0.15
    assert np.degrees(turn_rad.max()) < 3.0
    known = known_s(flown)
    assert known[0] < 2.0
    assert not ((known > LIES_S + 0.4) & (known < BACK_S)).any()
    assert (known > BACK_S + 0.2).sum() > 0.9 * 15 * (SECONDS - BACK_S - 0.2)
    (silent_s,), (heard_s,) = warned_s(flown, GIMBAL_SILENT), warned_s(flown, GIMBAL_HEARD)
    assert LIES_S < silent_s < LIES_S + 1.0 and BACK_S < heard_s < BACK_S + 0.3
    assert flown.odometry[-1].reset_counter == 0


def test_a_yaw_that_is_told_in_wrong_axes_turns_no_pose() -> None:
    def wrong_axes(after_s: float, sample: GimbalSample) -> GimbalSample:
        return replace(sample, yaw_from_north=after_s < LIES_S)

    flown = fly_with_gimbal(Mode.LOCK, SECONDS, wrong_axes)
    _, turn_rad = body_errors(flown.odometry)
    assert np.degrees(turn_rad.max()) < 4.0
    known = known_s(flown)
    assert not (known > LIES_S + 0.2).any()
    (said_s,) = warned_s(flown, GIMBAL_DISAGREES)
    assert LIES_S < said_s < LIES_S + 1.5
    assert flown.placed_share > 0.98
