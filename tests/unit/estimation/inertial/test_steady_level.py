"""The level by gyroscopes: it lasts where the autopilot's drifts, and learns the bias."""

from __future__ import annotations

import numpy as np
import pytest

from companion.estimation.inertial.steady_level import SteadyLevel
from companion.estimation.inertial.turn_integral import TurnIntegral
from companion.geometry.transforms import Array, rotation_from_vector, vector_from_rotation
from companion.telemetry import ImuSample

STEP_NS = 10_000_000
HEADING = rotation_from_vector(np.array([0.0, 0.0, 1.0]))


class Hover:
    """A body that rocks; its gyroscopes have a bias, and the autopilot's level drifts by it."""

    def __init__(self, bias_rad_s: Array, noise_rad_s: float = 0.0) -> None:
        self.turns = TurnIntegral()
        self.level = SteadyLevel(self.turns)
        self.bias_rad_s, self.t_ns = bias_rad_s, 0
        self.noise_rad_s, self.rng = noise_rad_s, np.random.default_rng(1)

    def true(self) -> Array:
        """`ned_from_body` (3, 3) now."""
        t_s = self.t_ns * 1e-9
        return HEADING @ rotation_from_vector(np.array([0.05 * np.sin(t_s), 0.03, 0.0]))

    def fly(
        self, seconds: float, seen: bool, drift_rad_s: float = 0.0, jump_rad: float = 0.0,
        less_biases: bool = False,
    ) -> float:  # fmt: skip
        """Go on, with images or without; how far off its level is then, apart from the first's."""
        begin_ns, found = self.t_ns, self.true()
        for n in range(int(seconds * 100)):
            before = self.true()
            self.t_ns += STEP_NS
            rates = vector_from_rotation(before.T @ self.true()) * 100.0 + self.bias_rad_s
            rates = rates + self.noise_rad_s * self.rng.standard_normal(3)
            drifted = drift_rad_s * (self.t_ns - begin_ns) * 1e-9 + jump_rad
            autopilot = rotation_from_vector(np.array([drifted, 0.0, 0.0])) @ self.true()
            sample = ImuSample(self.t_ns, rates, np.zeros(3))
            self.turns.take(sample)
            found = self.level.of(self.t_ns, rates, autopilot, less_biases)
            if seen and n % 5 == 0:
                self.level.see(self.t_ns, 1, self.true())
        off = vector_from_rotation(found @ self.true().T)
        return float(np.hypot(off[0], off[1]))


BIAS = np.array([0.002, -0.001, 0.0015])


def test_images_show_the_bias() -> None:
    hover = Hover(BIAS)
    hover.fly(20.0, seen=True)
    assert hover.level.bias_rad_s == pytest.approx(BIAS, abs=1e-4)


def test_it_lasts_where_the_level_of_the_autopilot_drifts() -> None:
    hover = Hover(BIAS)
    before_rad = hover.fly(30.0, seen=True)
    after_rad = hover.fly(5.0, seen=False, drift_rad_s=np.radians(0.05))
    assert after_rad - before_rad < np.radians(0.05)  # of 0.25


def test_without_images_it_is_the_level_of_the_autopilot() -> None:
    assert Hover(BIAS).fly(3.0, seen=False) < np.radians(0.1)


def test_gyroscopes_that_are_noisy_tell_no_level_of_their_own() -> None:
    """As in PX4's simulator: 0.09 rad/s in each sample, half a degree in each second."""
    hover = Hover(np.zeros(3), noise_rad_s=0.09)
    hover.fly(10.0, seen=True)
    off_rad = [hover.fly(0.5, seen=False) for _ in range(20)]
    assert np.sqrt(np.mean(np.square(off_rad))) < np.radians(0.3)


def test_a_correction_of_the_map_is_no_bias() -> None:
    hover = Hover(BIAS)
    hover.fly(20.0, seen=True)
    turned = rotation_from_vector(np.array([0.0, 0.02, 0.0])) @ hover.true()
    hover.level.see(hover.t_ns + 1, 1, turned)
    assert hover.level.bias_rad_s == pytest.approx(BIAS, abs=1e-4)


def test_two_levels_that_exclude_each_other_are_said() -> None:
    hover = Hover(BIAS)
    hover.fly(20.0, seen=True)
    assert not hover.level.contradicted
    hover.fly(0.1, seen=False, jump_rad=np.radians(4.0))
    assert hover.level.contradicted


def test_marked_samples_with_a_bias_that_an_ekf_would_have_found_are_as_measured() -> None:
    hover = Hover(np.array([0.003, -0.002, 0.0]))
    hover.fly(20.0, seen=True, less_biases=True)
    off_rad = hover.fly(5.0, seen=False, drift_rad_s=np.radians(0.05), less_biases=True)
    assert off_rad < np.radians(0.1)  # of 0.25


@pytest.mark.parametrize("bias_rad_s", [[0.001, -0.0005, 0.0], [0.0, 0.0, 0.005]])
def test_by_other_marked_samples_it_is_the_level_of_the_autopilot(bias_rad_s: list[float]) -> None:
    """An EKF may leave so little of roll and pitch, and all of what is about the vertical."""
    hover = Hover(np.array(bias_rad_s))
    hover.fly(20.0, seen=True, less_biases=True)
    off_rad = hover.fly(5.0, seen=False, drift_rad_s=np.radians(0.05), less_biases=True)
    assert off_rad == pytest.approx(np.radians(0.25), rel=0.01)


def test_a_bias_that_the_ekf_finds_late_is_not_taken_for_lasting() -> None:
    hover = Hover(np.array([0.003, -0.002, 0.0]))
    hover.fly(20.0, seen=True, less_biases=True)
    hover.bias_rad_s = np.zeros(3)
    hover.fly(60.0, seen=True, less_biases=True)
    off_rad = hover.fly(5.0, seen=False, drift_rad_s=np.radians(0.05), less_biases=True)
    assert off_rad == pytest.approx(np.radians(0.25), rel=0.01)
