"""Scale by accelerometers: right within what it states, and not stated where nothing shows it."""

from __future__ import annotations

import numpy as np
import pytest

from companion.estimation.georeference.alignment_sample import AlignmentSample
from companion.estimation.georeference.inertial_scale import LEAST_PLACES, InertialScale, settled
from companion.estimation.georeference.trajectory_alignment import Scale
from companion.estimation.inertial.acceleration_integral import AccelerationIntegral
from companion.estimation.inertial.inertial_motion import InertialStart
from companion.geometry.transforms import Array, Pose, rotation_from_vector
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
    """Keyframes and what an imperfect IMU measured along a path."""

    def __init__(self, path: Path, seed: int = 0, axes: Array | None = None) -> None:
        rng = np.random.default_rng(seed)
        self.integral = AccelerationIntegral()
        motion = MeasuredMotion(path, rng, SECONDS + 1.0, axes)
        self.bias_m_s2 = motion.bias_m_s2
        for sample in motion.samples():
            self.integral.take(sample)
        self.samples: list[AlignmentSample] = []
        for t_s in np.arange(0.5, SECONDS, 0.4):
            turn = turned(t_s)
            place = (path(t_s) + turn @ LEVER_M) / METRES_PER_UNIT
            noisy = MAP_FROM_NED @ place + rng.normal(scale=4e-4, size=3)
            pose = Pose(MAP_FROM_NED @ turn, noisy)
            attitude = motion.tilt @ turn
            self.samples.append(AlignmentSample(round(t_s * 1e9), pose, attitude))

    def scale(self) -> Scale | None:
        return settled(len(self.samples), self.samples.__getitem__, self.integral, LEVER_M)

    def live(self, start: InertialStart | None = None) -> list[Scale | None]:
        estimate = InertialScale(LEVER_M, start)
        return [
            estimate.update(n, self.samples.__getitem__, self.integral)
            for n in range(1, len(self.samples) + 1)
        ]


@pytest.mark.parametrize("seed", range(4))
def test_scale_of_a_weaving_flight(seed: int) -> None:
    found = Flight(weaving, seed).scale()
    assert found is not None
    error = np.log(found.scale / METRES_PER_UNIT)
    print(f"{100 * error:.2f} % off, {100 * found.sigma:.2f} % stated")
    assert found.sigma < 0.03
    assert abs(error) < 3.0 * found.sigma


def test_while_it_flies_it_is_never_far_from_what_it_states() -> None:
    course = Flight(weaving, 7).live()
    said = [each for each in course if each is not None and each.sigma < 0.1]
    assert len(said) > 30
    off = np.array([np.log(each.scale / METRES_PER_UNIT) / each.sigma for each in said])
    assert np.abs(off).max() < 3.5
    assert said[-1].sigma < 0.03


@pytest.mark.parametrize("path", [straight, hovering])
def test_none_is_stated_where_nothing_shows_it(path: Path) -> None:
    """A steady flight looks the same at each scale, and so does none at all."""
    for each in Flight(path).live():
        assert each is None or each.sigma > 0.1


@pytest.mark.parametrize("seed", range(3))
def test_a_velocity_known_at_the_first_keyframe_gives_it_at_once(seed: int) -> None:
    """In steady flight too, as long as the velocity is carried on well enough."""
    flight, rng = Flight(straight, seed), np.random.default_rng(seed)
    first, sigma_m_s, sigma_m_s2 = flight.samples[0].t_ns, 0.1, 0.05
    v_m_s = velocity(straight, first * 1e-9) + rng.normal(scale=sigma_m_s, size=3)
    bias_m_s2 = flight.bias_m_s2 + rng.normal(scale=sigma_m_s2, size=3)
    covariance = np.diag(np.repeat([sigma_m_s**2, sigma_m_s2**2], 3))
    found = flight.live(InertialStart(first, v_m_s, bias_m_s2, covariance))
    early = found[LEAST_PLACES]
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
    moved = Pose(rotation_from_vector(np.array([0.0, 0.02, 0.01])), np.array([0.3, -0.2, 0.1]))
    found: Scale | None = None
    for n in range(1, len(flight.samples) + 1):
        if n == 40:
            flight.samples = [
                AlignmentSample(each.t_ns, moved @ each.map_from_camera, each.ned_from_camera)
                for each in flight.samples
            ]
        found = estimate.update(n, flight.samples.__getitem__, flight.integral)
        if found is not None and found.sigma < 0.1:
            assert abs(np.log(found.scale / METRES_PER_UNIT)) < 3.5 * found.sigma
    assert found is not None and found.sigma < 0.03


def test_a_keyframe_that_the_map_has_lost_is_left_out() -> None:
    flight = Flight(weaving, 5)
    lost = {3, 4, 20}
    found = settled(
        len(flight.samples), lambda i: None if i in lost else flight.samples[i],
        flight.integral, LEVER_M,
    )  # fmt: skip
    assert found is not None
    assert found.n == len(flight.samples) - len(lost)
    assert abs(np.log(found.scale / METRES_PER_UNIT)) < 3.0 * found.sigma
