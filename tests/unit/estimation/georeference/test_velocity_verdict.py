"""A velocity that goes elsewhere than the positions is found; with a receiver's noise it is not."""

from __future__ import annotations

import re

import numpy as np
import pytest

from companion.estimation.georeference.velocity_verdict import NOT_USED, USED_AGAIN, VelocityVerdict
from companion.geometry.transforms import rotation_from_vector
from companion.messages import Warned

RATE_HZ = 5


def flown(
    rng: np.random.Generator, factors: list[tuple[float, float]], radius_m: float = 40.0,
    noise_m: float = 0.3,
) -> list[Warned]:  # fmt: skip
    """Circles of a minute each; in each velocity is stretched and turned (degrees) otherwise."""
    verdict, said = VelocityVerdict(), list[Warned]()
    travelled, walk = np.zeros(3), np.zeros(3)
    for step in range(60 * RATE_HZ * len(factors)):
        t_s = step / RATE_HZ
        angle, rate = 2 * np.pi * t_s / 60.0, 2 * np.pi / 60.0
        place = radius_m * np.array([np.cos(angle), np.sin(angle), 0.0])
        velocity = radius_m * rate * np.array([-np.sin(angle), np.cos(angle), 0.0])
        stretch, turn_deg = factors[step // (60 * RATE_HZ)]
        turn = rotation_from_vector(np.array([0.0, 0.0, np.radians(turn_deg)]))
        told = stretch * turn @ velocity + rng.normal(scale=0.1, size=3)
        travelled = travelled + told / RATE_HZ
        walk += rng.normal(scale=0.02, size=3)
        seen = place + walk + rng.normal(scale=noise_m, size=3)
        change = verdict.take(round(t_s * 1e9), seen, travelled)
        if change is not None:
            said.append(change)
    return said


def test_a_receivers_velocity_is_believed(rng: np.random.Generator) -> None:
    assert not flown(rng, [(1.0, 0.0)] * 5)
    assert not flown(rng, [(1.0, 0.0)] * 5, radius_m=5.0, noise_m=1.0)


@pytest.mark.parametrize(("stretch", "turn_deg"), [(1.1, 8.0), (0.8, 0.0), (1.0, 15.0)])
def test_one_that_is_stretched_or_turned_is_not(
    rng: np.random.Generator, stretch: float, turn_deg: float
) -> None:
    (said,) = flown(rng, [(stretch, turn_deg)] * 2)
    assert said.what == NOT_USED and said.t_ns < 45e9
    factor, turned_deg = map(float, re.findall(r"[-+]?\d+\.?\d*", said.detail))
    assert factor == pytest.approx(1 / stretch, rel=0.03)
    assert turned_deg == pytest.approx(-turn_deg, abs=2.0)


@pytest.mark.parametrize("stretch", [1.0, 1.2])
def test_a_velocity_is_proved_when_it_agrees_or_is_no_longer_used(stretch: float) -> None:
    verdict, said_s, proved_s = VelocityVerdict(), list[int](), list[int]()
    for t_s in range(60):
        place = np.array([4.0 * t_s, 0.0, 0.0])
        change = verdict.take(t_s * 10**9, place, stretch * place)
        said_s += [] if change is None else [t_s]
        proved_s += [] if verdict.unproved(t_s * 10**9) else [t_s]
    assert len(said_s) == (stretch != 1.0)
    assert proved_s[0] == (said_s[0] + 10 if said_s else 10)
    assert proved_s == list(range(proved_s[0], 60))


def test_it_is_used_again_when_it_agrees_for_long(rng: np.random.Generator) -> None:
    said = flown(rng, [(1.1, 8.0)] + [(1.0, 0.0)] * 4)
    assert [each.what for each in said] == [NOT_USED, USED_AGAIN] and said[1].good


def test_of_a_vehicle_that_stands_nothing_can_be_told(rng: np.random.Generator) -> None:
    assert not flown(rng, [(5.0, 90.0)], radius_m=0.2)


def test_after_a_gap_it_begins_anew() -> None:
    verdict = VelocityVerdict()
    for k in range(60):
        where = np.array([3.0 * k, 0.0, 0.0])
        jumped = where if k < 30 else where + [500.0, 0.0, 0.0]
        t_ns = (k if k < 30 else k + 20) * 1_000_000_000
        assert verdict.take(t_ns, jumped, where) is None
    assert verdict.believed
