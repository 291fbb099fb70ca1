"""Scale by accelerometers: right within what it states, and not stated where nothing shows it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from companion.estimation.georeference.inertial_scale import (
    SIGMA_SENSITIVITY,
    InertialScale,
    settled,
)
from companion.estimation.georeference.tracked_places import Places
from companion.estimation.georeference.trajectory_alignment import Scale
from companion.estimation.inertial.acceleration_integral import AccelerationIntegral
from companion.estimation.inertial.inertial_motion import InertialStart
from companion.geometry.transforms import Array, rotation_from_vector
from companion.telemetry import AttitudeSample
from tests.support.flights.measured_motion import (
    MeasuredMotion,
    Path,
    hovering,
    straight,
    turned,
    velocity,
    weaving,
)

METRES_PER_UNIT = 13.7
LEVER_M = np.array([0.11, -0.04, 0.07])
"""From body to camera, in axes of the camera, which are those of the body here."""
MAP_FROM_NED = rotation_from_vector(np.array([0.9, -0.4, 1.3]))
SECONDS = 24.0


class Flight:
    """Tracked frames, and what an imperfect IMU measured along a path."""

    def __init__(
        self, path: Path, seed: int = 0, axes: Array | None = None, seconds: float = SECONDS,
        rng: Any = None, noise: float = 4e-4, sigma_m_s2: float = 0.08,
    ) -> None:  # fmt: skip
        rng = rng or np.random.default_rng(seed)
        self.integral = AccelerationIntegral()
        motion = MeasuredMotion(path, rng, seconds + 1.0, axes, sigma_m_s2)
        self.bias_m_s2, self.tilt = motion.bias_m_s2, motion.tilt
        for sample in motion.samples():
            self.integral.take(sample)
        t_s = np.arange(0.5, seconds, 0.05)
        turns = np.array([turned(each) for each in t_s])
        where = np.array([path(each) for each in t_s]) + turns @ LEVER_M
        off = rng.normal(scale=noise, size=where.shape)
        way = np.linalg.norm(np.diff(where, axis=0, prepend=where[:1]), axis=1) / METRES_PER_UNIT
        off = off + np.cumsum(rng.normal(size=where.shape) * 1e-3 * np.sqrt(way)[:, None], axis=0)
        self.places = Places(
            np.round(t_s * 1e9).astype(np.int64), MAP_FROM_NED @ turns,
            where @ MAP_FROM_NED.T / METRES_PER_UNIT + off, motion.tilt @ turns,
        )  # fmt: skip

    def scale(self) -> Scale | None:
        return settled(self.places, self.integral, LEVER_M, np.eye(3))

    def live(self, start: InertialStart | None = None) -> list[Scale | None]:
        """The scale at each half second."""
        estimate, n = InertialScale(LEVER_M, start), len(self.places.t_ns)
        return [
            estimate.update(self.places.of(slice(end)), self.integral, np.eye(3))
            for end in range(10, n + 1, 10)
        ]


@pytest.mark.parametrize("seed", range(4))
def test_scale_of_a_weaving_flight(seed: int) -> None:
    found = Flight(weaving, seed).scale()
    assert found is not None
    error = np.log(found.scale / METRES_PER_UNIT)
    print(f"{100 * error:.2f} % off, {100 * found.sigma:.2f} % stated")
    assert found.sigma < 0.03
    assert abs(error) < 3.0 * found.sigma


def test_a_map_that_is_seen_from_far_above_where_it_began_is_weighted_as_noisy() -> None:
    """Its unit is what it began with, a metre above the ground: a pixel is many of its errors."""
    found = Flight(swaying, noise=6e-3).scale()
    assert found is not None
    error = np.log(found.scale / METRES_PER_UNIT)
    print(f"{100 * error:.2f} % off, {100 * found.sigma:.2f} % stated")
    assert found.sigma < 0.04
    assert abs(error) < 3.0 * found.sigma


def test_while_it_flies_it_is_never_far_from_what_it_states() -> None:
    course = Flight(weaving, 7).live()
    said = [each for each in course if each is not None and each.sigma < 0.1]
    assert len(said) > 30
    off = np.array([np.log(each.scale / METRES_PER_UNIT) / each.sigma for each in said])
    assert np.abs(off).max() < 3.5
    assert said[-1].sigma < 0.03


class Exact:
    """Source of noise that gives none."""

    def normal(self, loc: float = 0.0, scale: float = 1.0, size: Any = ()) -> Array:
        return np.zeros(size)


def swaying(t_s: float) -> Array:
    """Barely: 0.2 m/s2."""
    return np.array([3.0 * t_s, 0.6 * np.sin(0.6 * t_s), -20.0 + 0.3 * np.sin(0.4 * t_s)])


def test_what_is_not_known_at_first_does_not_make_a_map_small() -> None:
    """Its place and velocity: they are no noise of what accelerometers measured, here exactly."""
    flight = Flight(swaying, rng=Exact(), seconds=12.0)
    found = flight.live()[7:]  # from four seconds on
    off = [each and np.log(each.scale / METRES_PER_UNIT) / each.sigma for each in found]
    assert all(each is not None and abs(each) < 0.8 for each in off)


@pytest.mark.parametrize("path", [straight, hovering])
def test_none_is_stated_where_nothing_shows_it(path: Path) -> None:
    """A steady flight looks the same at each scale, and so does none at all."""
    for each in Flight(path).live():
        assert each is None or each.sigma > 0.1


@pytest.mark.parametrize("seed", range(3))
def test_a_velocity_known_at_the_first_keyframe_gives_it_at_once(seed: int) -> None:
    """In steady flight too, as long as the velocity is carried on well enough."""
    flight, rng = Flight(straight, seed), np.random.default_rng(seed)
    first, sigma_m_s, sigma_m_s2 = int(flight.places.t_ns[0]), 0.1, 0.05
    v_m_s = velocity(straight, first * 1e-9) + rng.normal(scale=sigma_m_s, size=3)
    bias_m_s2 = flight.bias_m_s2 + rng.normal(scale=sigma_m_s2, size=3)
    covariance = np.diag(np.repeat([sigma_m_s**2, sigma_m_s2**2], 3))
    found = flight.live(InertialStart(first, v_m_s, bias_m_s2, covariance))
    early = found[5]  # after three seconds
    assert early is not None and early.sigma < 0.06
    off = [
        np.log(each.scale / METRES_PER_UNIT) / each.sigma
        for each in found
        if each is not None and each.sigma < 0.1
    ]
    assert len(off) > 30 and np.abs(off).max() < 3.5


def test_an_imu_mounted_otherwise_gives_none() -> None:
    """Its gravity points elsewhere: no vehicle accelerates so for long."""
    axes = rotation_from_vector(np.array([0.0, np.pi / 2, 0.0]))
    assert set(Flight(weaving, axes=axes).live()) == {None}


def test_a_map_that_is_corrected_in_flight_keeps_its_scale() -> None:
    """A closed loop moves it by more than it drifts."""
    flight, estimate = Flight(weaving, 3), InertialScale(LEVER_M)
    turn, by = rotation_from_vector(np.array([0.0, 0.02, 0.01])), np.array([0.3, -0.2, 0.1])
    found: Scale | None = None
    for end in range(10, len(flight.places.t_ns) + 1, 10):
        if end == 300:
            before = flight.places
            flight.places = before._replace(
                rotations=turn @ before.rotations, places=before.places @ turn.T + by
            )
        found = estimate.update(flight.places.of(slice(end)), flight.integral, np.eye(3))
        if found is not None and found.sigma < 0.1:
            assert abs(np.log(found.scale / METRES_PER_UNIT)) < 3.5 * found.sigma
    assert found is not None and found.sigma < 0.03


def test_frames_that_are_missing_are_left_out() -> None:
    """Tracking was lost for some seconds, of one map."""
    flight = Flight(weaving, 5)
    kept = np.flatnonzero((flight.places.t_ns < 8e9) | (flight.places.t_ns > 12e9))
    found = settled(flight.places.of(kept), flight.integral, LEVER_M, np.eye(3))
    assert found is not None
    assert found.sigma < 0.03
    assert abs(np.log(found.scale / METRES_PER_UNIT)) < 3.0 * found.sigma


def test_a_gap_in_the_accelerations_is_not_integrated_across() -> None:
    flight = Flight(weaving, 6)
    gap = AccelerationIntegral()
    for sample in MeasuredMotion(weaving, np.random.default_rng(6), SECONDS + 1.0).samples():
        if isinstance(sample, AttitudeSample) or not 9.0 < sample.t_ns * 1e-9 < 9.5:
            gap.take(sample)
    found = settled(flight.places, gap, LEVER_M, np.eye(3))
    assert found is not None
    assert found.sigma < 0.03
    assert abs(np.log(found.scale / METRES_PER_UNIT)) < 3.0 * found.sigma


def test_what_is_stated_is_what_it_is_off_by() -> None:
    """Over 20 flights; without what is stated of the accelerometer's own scale, which is exact."""
    off = []
    for seed in range(100, 120):
        early = Flight(weaving, seed, seconds=5.0).scale()
        assert early is not None
        sigma = np.sqrt(early.sigma**2 - SIGMA_SENSITIVITY**2)
        off.append(np.log(early.scale / METRES_PER_UNIT) / sigma)
    print(f"normalised squared error {np.mean(np.square(off)):.2f}, mean {np.mean(off):.2f}")
    assert 0.3 < np.mean(np.square(off)) < 2.0
    assert abs(np.mean(off)) < 0.7


def gentle(t_s: float) -> Array:
    """A hover that is not held: 0.6 m/s2."""
    return np.array([0.5 * t_s, 0.8 * np.sin(0.9 * t_s), -5.0 + 0.5 * np.sin(0.6 * t_s)])


@pytest.mark.parametrize("noise", [3e-5, 2e-4])
def test_vibration_is_no_motion_that_the_map_lacks(noise: float) -> None:
    """Of motors, aliased: it moves a body by 5 mm in 0.3 s; maps from close by are that exact."""
    off = []
    for seed in range(200, 210):
        found = Flight(gentle, seed, seconds=16.0, noise=noise, sigma_m_s2=0.5).scale()
        assert found is not None
        off.append(np.log(found.scale / METRES_PER_UNIT) / found.sigma)
    print(f"normalised squared error {np.mean(np.square(off)):.2f}, mean {np.mean(off):.2f}")
    assert np.mean(np.square(off)) < 1.8
    assert abs(np.mean(off)) < 0.7


def test_the_vertical_is_better_than_the_autopilots() -> None:
    """A body that turns tells a tilt of its attitude from a bias of its accelerometers."""
    own, found, stated = [], [], []
    for seed in range(6):
        flight = Flight(weaving, seed)
        scale = flight.scale()
        assert scale is not None and scale.down_map is not None
        down = np.array([0.0, 0.0, 1.0])
        own.append(_angle_rad(flight.tilt.T @ down, down))
        found.append(_angle_rad(scale.down_map, MAP_FROM_NED @ down))
        stated.append(scale.sigma_down_rad)
    print(
        f"off by {np.degrees(found).round(2)} degrees, the autopilot by {np.degrees(own).round(2)}"
    )
    assert np.sqrt(np.mean(np.square(found))) < 0.4 * np.sqrt(np.mean(np.square(own)))
    off = np.mean(np.square(found)) / np.mean(np.square(stated)) / 2.0
    print(f"stated {np.degrees(stated).round(2)} degrees to each side: {off:.2f} of it, squared")
    assert 0.2 < off < 3.0


def _angle_rad(first: Array, second: Array) -> float:
    return float(np.arccos(np.clip(first @ second, -1.0, 1.0)))
