"""Scale of a map by accelerometers, without any place or distance being measured.

With rotations known, the motion of the body is linear in its velocity, the accelerometers' bias and
a tilt, and only the scale is not. So for each of a bank of scales, and of noises of the map, a
linear Kalman filter gives the likelihood of what the map shows; their mean and spread are the scale
and its standard deviation, with no first guess and no linearisation about a wrong one. Places of
keyframes are measurements, not regressors: as regressors, their noise would make the scale small.

What makes scale observable is a change of acceleration; in a straight and steady flight the
likelihood is flat, and its spread says so (Martinelli, "Vision and IMU Data Fusion: Closed-Form
Solutions", IEEE T-RO 2012).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from companion.estimation.georeference.alignment_sample import AlignmentSample, mean_rotation
from companion.estimation.georeference.trajectory_alignment import Scale
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

TILT_TAU_S = 200.0
"""A tilt of the levelled map stays so long."""
SIGMA_DRIFT = 1e-3
"""Drift of the map over a way of one unit, in units."""
MAP_NOISES = (2e-4, 4e-4, 8e-4, 1.6e-3)
"""White noise of a keyframe's place, units: 0.1 to 0.8 pixels of 500 at the typical distance."""
LEAST_SCALE, MOST_SCALE = 0.1, 1000.0
"""Metres per unit. The unit is the typical distance of what the first two keyframes see."""
N_SCALES = 25
SPAN = 4.5
"""Standard deviations on either side that a finer bank covers."""
N_STATE = 14
START, DRIFT = slice(VELOCITY.start, BIAS.stop), slice(11, 14)
SIGMA_SENSITIVITY = 0.01
"""Of an accelerometer's own scale: datasheets of those in autopilots state 0.5 to 1 %."""
MOST_SUSTAINED_M_S2 = 2.0
"""A vehicle does not accelerate so on average over seconds; turned axes of the IMU look so."""
LEAST_PLACES, LEAST_PLACES_STARTED = 8, 3
"""Without and with a known velocity at the first."""
WINDOW = 200
"""Places that a new bank begins with: 80 s and more."""
AT_ONCE = 10
"""Places of a new bank in one call: some 10 ms."""
MOVED = 0.02
"""A place that has moved so far in the map, in units, was corrected by more than it drifts."""
NARROWINGS = 6
"""From a factor of 10 000 to a hundredth, at least threefold each."""
SampleAt = Callable[[int], "AlignmentSample | None"]


class ScaleBank:
    """Filters of N_SCALES scales, evenly spaced in their logarithm, times all MAP_NOISES.

    Their state is place, velocity, bias in body axes, horizontal acceleration by tilt, and the
    drift of the map; all in NED, metres, seconds, but for the bias. Where the motion was known at
    the first place, that is its `start`.
    """

    def __init__(
        self, centre_log: float, half_width: float, level: Array, lever_camera_m: Array,
        start: InertialStart | None = None,
    ) -> None:  # fmt: skip
        logs = centre_log + half_width * np.linspace(-1.0, 1.0, N_SCALES)
        grid, noises = np.meshgrid(logs, MAP_NOISES, indexing="ij")
        self._log, self._scale = grid.ravel(), np.exp(grid.ravel())
        self._sigma_map_m = self._scale * noises.ravel()
        self._level, self._lever_camera_m, self._start = level, lever_camera_m, start
        n = len(self._log)
        self._x, self._covariance = np.zeros((n, N_STATE)), np.zeros((n, N_STATE, N_STATE))
        self._covariance[:, BIAS, BIAS] = SIGMA_BIAS_M_S2**2 * np.eye(3)
        self._covariance[:, TILT, TILT] = SIGMA_TILT_M_S2**2 * np.eye(2)
        self._log_likelihood, self._squared = np.zeros(n), np.zeros(n)
        self._last: tuple[int, Array, Array] | None = None
        """Time, levelled place and `ned_from_attitude` of the last sample."""
        self._gained_m_s, self._lasted_s = np.zeros(3), 0.0
        self.n = 0
        """Places taken."""

    def advance(
        self, samples: Sequence[AlignmentSample], integral: AccelerationIntegral, delay_ns: int
    ) -> None:
        """Take keyframes that come next. Autopilot stamps are late by `delay_ns`."""
        for sample in samples:
            assert sample.ned_from_camera is not None
            ned_from_camera = self._level @ sample.map_from_camera.rotation
            levelled = self._level @ sample.map_from_camera.translation
            turn = ned_from_camera @ sample.ned_from_camera.T
            lever_m = ned_from_camera @ self._lever_camera_m
            t_ns = sample.t_ns + delay_ns
            change = None if self._last is None else integral.between(self._last[0], t_ns)
            if change is None or self._last is None:
                self._begin(sample.t_ns, levelled, lever_m)
            else:
                _, before, turn_before = self._last
                self._predict(change, 0.5 * (turn_before + turn), integral.density_m_s2)
                way = float(np.linalg.norm(levelled - before))
                self._grow(DRIFT, (SIGMA_DRIFT * self._scale) ** 2 * way)
            self._correct(levelled, lever_m)
            self._last = t_ns, levelled, turn
            self.n += 1

    @property
    def posterior(self) -> tuple[float, float]:
        """Mean and standard deviation of the logarithm of the scale."""
        weight = np.exp(self._log_likelihood - self._log_likelihood.max())
        weight /= weight.sum()
        mean = float(weight @ self._log)
        return mean, float(np.sqrt(weight @ (self._log - mean) ** 2))

    @property
    def logs(self) -> Array:
        """Logarithms of its scales (N_SCALES,)."""
        return self._log[:: len(MAP_NOISES)]

    @property
    def normalised_innovation(self) -> float:
        """Squared innovation per degree of freedom: 1 where noises and model are true."""
        likeliest = int(np.argmax(self._log_likelihood))
        return float(self._squared[likeliest]) / (3.0 * max(self.n, 1))

    @property
    def sustained_m_s2(self) -> float:
        """Size of the mean acceleration that was measured."""
        return float(np.linalg.norm(self._gained_m_s)) / max(self._lasted_s, 1e-9)

    def moved(self, sample: AlignmentSample) -> float:
        """Distance by which the last place has moved since it was taken, map units."""
        if self._last is None:
            return 0.0
        levelled = self._level @ sample.map_from_camera.translation
        return float(np.linalg.norm(levelled - self._last[1]))

    def _grow(self, part: slice, variance: Array) -> None:
        self._covariance[:, part, part] += variance[:, None, None] * np.eye(3)

    def _begin(self, t_ns: int, levelled: Array, lever_m: Array) -> None:
        """Place and velocity anew: there are no measurements since the last sample."""
        for part in (PLACE, VELOCITY):
            self._covariance[:, part, :] = self._covariance[:, :, part] = 0.0
        self._x[:, PLACE] = self._scale[:, None] * levelled - lever_m - self._x[:, DRIFT]
        self._x[:, VELOCITY] = 0.0
        self._grow(PLACE, 1e4 * self._sigma_map_m**2)
        start = self._start
        if start is not None and start.t_ns == t_ns:
            self._x[:, START] = np.r_[start.velocity_ned_m_s, start.bias_body_m_s2]
            self._covariance[:, START, START] = start.covariance
        else:
            self._grow(VELOCITY, np.full(len(self._log), SIGMA_SPEED_M_S**2))

    def _predict(self, change: Change, turn: Array, density: float) -> None:
        found = motion(change, turn, density, TILT_TAU_S, N_STATE)
        self._gained_m_s += found.gained_m_s
        self._lasted_s += change.dt_s
        self._x = self._x @ found.step.T
        self._x[:, PLACE] += found.moved_m
        self._x[:, VELOCITY] += found.gained_m_s
        self._covariance = found.step @ self._covariance @ found.step.T + found.noise

    def _correct(self, levelled: Array, lever_m: Array) -> None:
        """Compare with a place in the map: that of the body, and drift."""
        where = self._scale[:, None] * levelled - lever_m
        innovation = where - self._x[:, PLACE] - self._x[:, DRIFT]
        seen = self._covariance[:, PLACE] + self._covariance[:, DRIFT]
        covariance = seen[:, :, PLACE] + seen[:, :, DRIFT]
        covariance = covariance + (self._sigma_map_m**2)[:, None, None] * np.eye(3)
        solved = np.linalg.solve(covariance, np.concatenate([seen, innovation[..., None]], 2))
        gain, weighted = solved[..., :-1], solved[..., -1]
        self._x += np.einsum("gij,gi->gj", gain, innovation)
        self._covariance -= gain.transpose(0, 2, 1) @ seen
        self._covariance = 0.5 * (self._covariance + self._covariance.transpose(0, 2, 1))
        squared = np.einsum("gi,gi->g", innovation, weighted)
        # the density of the place in map units, which is what was seen
        determinant = np.linalg.slogdet(covariance)[1] - 6.0 * self._log
        if self.n:  # the first says nothing of the scale
            self._log_likelihood -= 0.5 * (squared + determinant)
        self._squared += squared


class InertialScale:
    """Scale of one map while it grows.

    A bank that has narrowed the scale gives way to one that covers less more finely, and one whose
    map has moved to one of the latest places; that catches up a few places with each call.
    `start` is the motion at its first keyframe, where inertial navigation knew it.
    """

    def __init__(
        self, lever_camera_m: Array, start: InertialStart | None = None, at_once: int = AT_ONCE,
        window: int = WINDOW,
    ) -> None:  # fmt: skip
        self._lever_camera_m, self._start = lever_camera_m, start
        self._least_places = LEAST_PLACES if start is None else LEAST_PLACES_STARTED
        self._at_once, self._window = at_once, window
        self._bank: ScaleBank | None = None
        self._next: ScaleBank | None = None
        self._n_taken = self._n_next = 0
        """Numbers of the samples that come next to the bank, and to the one that follows it."""

    def update(
        self, n: int, sample_at: SampleAt, integral: AccelerationIntegral, delay_ns: int = 0
    ) -> Scale | None:
        """Scale by `n` keyframes in order of time; None while it is unknown.

        `sample_at` gives a keyframe as the map has it now, None where that has lost it.
        """
        if n < self._least_places:
            return None
        if self._bank is None:
            half = 0.5 * float(np.log(MOST_SCALE / LEAST_SCALE))
            centre = float(np.log(LEAST_SCALE)) + half
            self._n_taken = max(0, n - self._window)
            self._bank = self._new_bank(centre, half, sample_at, self._n_taken, n)
            if self._bank is None:
                return None
        last = sample_at(self._n_taken - 1) if self._bank.n else None
        has_moved = last is not None and self._bank.moved(last) > MOVED
        if not has_moved:
            self._n_taken = self._advance(
                self._bank, self._n_taken, n, sample_at, integral, delay_ns
            )
        if self._next is None and (has_moved or self._is_coarse(self._bank)):
            mean, sigma = self._bank.posterior
            self._n_next = max(0, n - self._window)
            half = max(SPAN * sigma, 2.0 * float(self._bank.logs[1] - self._bank.logs[0]))
            self._next = self._new_bank(mean, half, sample_at, self._n_next, n)
        if self._next is not None:
            self._n_next = self._advance(self._next, self._n_next, n, sample_at, integral, delay_ns)
            if self._n_next == n:
                self._bank, self._next, self._n_taken = self._next, None, n
        return self._scale(self._bank)

    def _new_bank(
        self, centre_log: float, half_width: float, sample_at: SampleAt, begin: int, end: int
    ) -> ScaleBank | None:
        samples = [each for i in range(begin, end) if (each := sample_at(i)) is not None]
        level = mean_rotation(samples)
        if level is None:
            return None
        return ScaleBank(centre_log, half_width, level, self._lever_camera_m, self._start)

    def _advance(
        self, bank: ScaleBank, begin: int, n: int, sample_at: SampleAt,
        integral: AccelerationIntegral, delay_ns: int,
    ) -> int:  # fmt: skip
        end = min(begin + self._at_once, n)
        samples = [each for i in range(begin, end) if (each := sample_at(i)) is not None]
        bank.advance(samples, integral, delay_ns)
        return end

    def _is_coarse(self, bank: ScaleBank) -> bool:
        """True if the scale is narrow within the bank, or near its edge."""
        if bank.n < self._least_places:
            return False
        mean, sigma = bank.posterior
        low, high = float(bank.logs[0]), float(bank.logs[-1])
        near_edge = min(mean - low, high - mean) < 2.0 * sigma
        return near_edge or 2.0 * SPAN * sigma < 0.4 * (high - low)

    def _scale(self, bank: ScaleBank) -> Scale | None:
        if bank.n < self._least_places or bank.sustained_m_s2 > MOST_SUSTAINED_M_S2:
            return None
        mean, sigma = bank.posterior
        spacing = 0.3 * float(bank.logs[1] - bank.logs[0])  # of an even spread between two
        unlikely = max(1.0, float(np.sqrt(bank.normalised_innovation)))
        sigma = float(np.hypot(unlikely * np.hypot(sigma, spacing), SIGMA_SENSITIVITY))
        return Scale(float(np.exp(mean)), sigma, "accelerometers", bank.n)


def settled(
    n: int, sample_at: SampleAt, integral: AccelerationIntegral, lever_camera_m: Array,
    delay_ns: int = 0, start: InertialStart | None = None,
) -> Scale | None:  # fmt: skip
    """Scale by all keyframes of a finished map; None while it is unknown."""
    estimate, found = InertialScale(lever_camera_m, start, at_once=n, window=n), None
    for _ in range(NARROWINGS):
        found = estimate.update(n, sample_at, integral, delay_ns)
    return found
