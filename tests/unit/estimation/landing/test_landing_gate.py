"""Which positions of a landing marker are let through."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from companion.config import Measurement
from companion.estimation.landing.landing_gate import (
    ABOVE,
    MAX_AGE_NS,
    NO_ATTITUDE,
    NOT_BELIEVED,
    NOT_LEVEL,
    STALE,
    UNCERTAIN,
    UNPROVEN,
    LandingGate,
    TargetToSend,
)
from companion.estimation.landing.marker_detector import NOT_SEEN
from companion.geometry.transforms import quaternion_from_euler, rotation_from_vector
from companion.messages import LandingTarget
from companion.telemetry import AttitudeSample

MS = 1_000_000
ROLL_RAD = 0.1
NED_FROM_BODY = rotation_from_vector(np.array([ROLL_RAD, 0.0, 0.0]))
BELOW = NED_FROM_BODY.T @ np.array([0.4, -0.2, 6.0])
UP = NED_FROM_BODY.T @ np.array([0.0, 0.0, -1.0])
GOOD = LandingTarget(0, 0, BELOW, np.full(3, 0.02), UP[None], 60.0)


class Flown:
    """Frames at 30 Hz and attitudes at 50 Hz, 40 ms late."""

    def __init__(self, use: tuple[Measurement, ...] = ("attitude",), heard: bool = True) -> None:
        self.gate, self.heard = LandingGate(use), heard
        self.t_ns = 10**18

    def see(self, n: int = 1, like: LandingTarget = GOOD, late_ns: int = 40 * MS) -> list[
        TargetToSend | None
    ]:  # fmt: skip
        out = []
        for _ in range(n):
            self.t_ns += 33 * MS
            if self.heard:
                attitude = quaternion_from_euler(ROLL_RAD, 0.0, 0.0)
                self.gate.take_attitude(AttitudeSample(self.t_ns, attitude, np.zeros(3)))
            out.append(self.gate.take(replace(like, t_ns=self.t_ns), self.t_ns + late_ns))
        return out


def test_the_third_in_a_row_is_sent_with_its_offset_in_ned() -> None:
    flown = Flown()
    first, second, third = flown.see(3)
    assert first is None and second is None
    assert third is not None and flown.gate.why_not == ""
    assert third.position_body_m == pytest.approx(BELOW)
    assert third.offset_ned_m == pytest.approx([0.4, -0.2, 6.0])


@pytest.mark.parametrize(
    ("like", "why"),
    [
        (replace(GOOD, sigma_body_m=np.full(3, 0.4)), UNCERTAIN),
        (replace(GOOD, sigma_body_m=np.full(3, np.nan)), UNCERTAIN),
        (replace(GOOD, position_body_m=-BELOW), ABOVE),
        (replace(GOOD, normals_body=np.array([[0.0, 0.6, -0.8]])), NOT_LEVEL),
        (LandingTarget(0, 0, why_not=NOT_SEEN), NOT_SEEN),
    ],
)
def test_one_that_is_refused_begins_the_proof_anew(like: LandingTarget, why: str) -> None:
    flown = Flown()
    assert flown.see(3)[-1] is not None
    assert flown.see(1, like) == [None]
    assert flown.gate.why_not == why
    assert flown.see(2) == [None, None]
    assert flown.gate.why_not == UNPROVEN
    assert flown.see(1)[0] is not None


def test_of_two_poses_the_level_one_counts() -> None:
    both = replace(GOOD, normals_body=np.stack([[0.0, 0.6, -0.8], UP]))
    assert Flown().see(3, both)[-1] is not None


def test_a_late_one_is_refused() -> None:
    flown = Flown()
    assert flown.see(4, late_ns=MAX_AGE_NS + MS) == [None] * 4
    assert flown.gate.why_not == STALE


def test_one_that_jumps_is_refused() -> None:
    """A square that has the code by chance is elsewhere in each image."""
    flown = Flown()
    elsewhere = replace(GOOD, position_body_m=BELOW + [2.0, 0.0, 0.0])
    for like in (GOOD, elsewhere) * 4:
        assert flown.see(1, like) == [None]
    assert flown.gate.why_not == UNPROVEN


def test_without_an_attitude_that_is_believed_nothing_is_sent() -> None:
    deaf, disbelieving = Flown(heard=False), Flown(use=("imu",))
    assert deaf.see(4) == [None] * 4 and deaf.gate.why_not == NO_ATTITUDE
    assert disbelieving.see(4) == [None] * 4 and disbelieving.gate.why_not == NOT_BELIEVED
