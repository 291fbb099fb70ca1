"""Integrals of the measured acceleration in NED, by accelerometers and a given attitude.

It is the autopilot's, or its heading alone, with a level by gyroscopes whose bias is known
(`SteadyLevel`); not where a gimbal's head is what the integrals are of, nor where the samples are
less the autopilot's own biases.

Between two times they give the change of velocity and the displacement that an unbiased
accelerometer measured, and how a bias in body axes changes both: preintegration (Forster et al.,
"On-Manifold Preintegration for Real-Time Visual-Inertial Odometry", 2017) with given rotations.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.estimation.inertial.steady_level import SteadyLevel
from companion.estimation.inertial.turn_integral import TurnIntegral
from companion.estimation.sample_series import SampleSeries
from companion.geometry.geodesy import STANDARD_GRAVITY_M_S2
from companion.geometry.transforms import Array
from companion.slam.compiled.inertial_steps import integrated, rotation_between
from companion.telemetry import AttitudeSample, ImuSample

GRAVITY_NED_M_S2 = np.array([0.0, 0.0, STANDARD_GRAVITY_M_S2])
"""Differences from it on earth count as bias."""
_NO_ROWS = np.zeros((4, 3))
MAX_GAP_NS = 100_000_000
"""Longer without a sample, nothing is integrated across."""
NO_GAP = 1e-6
"""Difference of two interpolated numbers of gaps that are the same but for rounding."""
NOISE_TAU, ONSET_TAU, ONSET = 500, 50, 2.0
"""Samples over which the white noise is averaged. Where that of the second is so many times that of
the first, it has set in: motors have started. By chance it is so at six standard deviations."""
LEAST_NOISE_M_S2 = 0.00980665 / np.sqrt(12.0)
"""Rounding to 1 mg, as RAW_IMU states it."""


class Change(NamedTuple):
    """Velocity and displacement (3,) gained from rest, and their derivatives (3, 3) by the bias."""

    dt_s: float
    velocity_m_s: Array
    displacement_m: Array
    velocity_by_bias: Array
    displacement_by_bias: Array


class AccelerationIntegral:
    """Integrates what arrives; attitude and IMU may come in any order up to a few samples.

    The integrals are those of a place `lever_body_m` (3,) from the IMU, in the body: a gimbal's
    head, which does not turn with the body. A level of its own is for dead reckoning: within
    seconds it is the better one. A scale, which is found over minutes, is the better by the
    autopilot's, which wanders about the true one: for that the `turns` of an integral that takes
    each sample before are given.
    """

    def __init__(
        self, lever_body_m: Array | None = None, turns: TurnIntegral | None = None
    ) -> None:
        self._lever_body_m = lever_body_m
        self._own_level = turns is None and lever_body_m is None
        self.believed = True
        """False while nobody knows yet whether the samples are right."""
        self.turns = TurnIntegral() if turns is None else turns
        """Of the same samples, without the attitude; of a body that turns as the camera does."""
        self.level = SteadyLevel(self.turns)
        """Of such a body, too; it is used where the integral is by its own level."""
        self._waiting: deque[ImuSample] = deque(maxlen=1000)
        self._attitudes: tuple[AttitudeSample, ...] = ()
        self._series = SampleSeries()
        self._last: tuple[int, Array] | None = None
        """Time of the last sample; acceleration and its derivative by the bias, rows (4, 3)."""
        self._velocity, self._displacement, self._n_gaps = np.zeros((4, 3)), np.zeros((4, 3)), 0
        """Integrals of such rows, of the IMU, and number of gaps."""
        self._lever = np.zeros((2, 3))
        """Difference of the place to the IMU, by the last sample: it is not integrated."""
        self._raw: deque[list[float]] = deque(maxlen=3)
        self._noise_variance = self._newest_variance = 0.0
        self._n = 0
        self._interval_s = 0.01

    def take(self, sample: AttitudeSample | ImuSample) -> None:
        """Add a sample; samples of a kind come in order of time."""
        if isinstance(sample, ImuSample):
            self._see_noise(sample)
            if self._own_level:
                self.turns.take(sample)
            self._waiting.append(sample)
        elif not self._attitudes or sample.t_ns > self._attitudes[-1].t_ns:
            self._attitudes = (*self._attitudes[-1:], sample)
        self._integrate()

    def prune(self, before_ns: int, keyframes_ns: Array) -> None:
        """Drop integrals before a time, except at the times of keyframes (N,), sorted."""
        self._series.prune(before_ns, keyframes_ns)

    def withdraw(self, since_ns: int) -> None:
        """Drop integrals from a time on: the samples were wrong. There is a gap."""
        self._series.drop_since(since_ns)
        self.turns.withdraw(since_ns)
        self._waiting.clear()
        self.level.reset()
        self._last = None

    @property
    def has_samples(self) -> bool:
        """True once accelerations came."""
        return len(self._series) > 1

    @property
    def newest_ns(self) -> int:
        """Time up to which there are integrals; before there are any, before all times."""
        return -(2**62) if self._last is None else self._last[0]

    @property
    def sigma_m_s2(self) -> float:
        """White noise of a sample of the accelerometers, from their own differences."""
        return max(float(np.sqrt(self._noise_variance)), float(LEAST_NOISE_M_S2))

    @property
    def density_m_s2(self) -> float:
        """The same as a density, m/s2 per root of Hz."""
        return self.sigma_m_s2 * float(np.sqrt(self._interval_s))

    def between(self, from_ns: int, to_ns: int) -> Change | None:
        """Integrals between two times; None where measurements are missing."""
        sums, known = self.at(np.array([from_ns, to_ns]))
        start, end = sums
        if not known.all() or abs(start[8, 0] - end[8, 0]) > NO_GAP:
            return None
        dt_s = (to_ns - from_ns) * 1e-9
        change = end - start
        return Change(
            dt_s, change[0], change[1] - dt_s * start[0],
            change[2:5], change[5:8] - dt_s * start[2:5],
        )  # fmt: skip

    def beyond(self, dt_s: float) -> Change:
        """Integrals over a time from the newest sample on, were its acceleration to stay."""
        assert self._last is not None, "no sample yet"
        gained, moved = dt_s * self._last[1], 0.5 * dt_s * dt_s * self._last[1]
        return Change(dt_s, gained[0], moved[0], gained[1:], moved[1:])

    def at(self, t_ns: NDArray[np.int64]) -> tuple[Array, NDArray[np.bool_]]:
        """Integrals (N, 9, 3) up to times (N,), and a mask of times where they are known.

        Rows: velocity, displacement, their derivatives by the bias, and the number of gaps so far.
        """
        if not self.has_samples:
            return np.zeros((len(t_ns), 9, 3)), np.zeros(len(t_ns), bool)
        sums, known = self._series.at(t_ns)
        newest = self._series.newest
        if newest is not None:  # the series is sparse
            for n in np.flatnonzero((t_ns > newest[0]) & (t_ns <= self.newest_ns)):
                share = (t_ns[n] - newest[0]) / (self.newest_ns - newest[0])
                sums[n], known[n] = newest[1] + share * (self._newest_sums() - newest[1]), True
        return sums, known

    def _see_noise(self, sample: ImuSample) -> None:
        """White noise by second differences, in which motion hardly shows at 100 Hz."""
        self._raw.append(sample.accel_m_s2.tolist())
        if len(self._raw) < 3:
            return
        x, y, z = (a - 2.0 * b + c for a, b, c in zip(*self._raw, strict=True))
        variance = (x * x + y * y + z * z) / 3.0 / 6.0
        self._n = min(self._n + 1, NOISE_TAU)
        self._noise_variance += (variance - self._noise_variance) / self._n
        self._newest_variance += (variance - self._newest_variance) / min(self._n, ONSET_TAU)
        if self._newest_variance > ONSET * self._noise_variance:
            self._noise_variance, self._n = self._newest_variance, ONSET_TAU

    def _integrate(self) -> None:
        if len(self._attitudes) < 2:
            return
        before, after = self._attitudes
        span_ns = after.t_ns - before.t_ns
        # straight between the two, which at 5 rad/s and 50 Hz turns wrongly by 0.00004 rad at most
        first, second = before.ned_from_body, after.ned_from_body
        second = second if first @ second >= 0.0 else -second
        while self._waiting and self._waiting[0].t_ns <= after.t_ns:
            sample = self._waiting.popleft()
            if sample.t_ns < before.t_ns or span_ns > MAX_GAP_NS:
                self._last = None
                continue
            share = (sample.t_ns - before.t_ns) / span_ns
            rotation = rotation_between(first, second, share)
            if self._own_level:
                if self._last is None or sample.t_ns - self._last[0] > MAX_GAP_NS:
                    self.level.reset()
                rates = sample.gyro_rad_s
                rotation = self.level.of(sample.t_ns, rates, rotation, sample.less_biases)
            elif self._lever_body_m is not None:
                self._lever[0] = rotation @ np.cross(sample.gyro_rad_s, self._lever_body_m)
                self._lever[1] = rotation @ self._lever_body_m
            self._add(sample.t_ns, sample.accel_m_s2, rotation)

    def _add(self, t_ns: int, accel_m_s2: Array, rotation: Array) -> None:
        """Trapezoidal rule; displacement with acceleration linear between samples."""
        dt_s, was = 0.0, _NO_ROWS
        if self._last is None or not 0 < t_ns - self._last[0] <= MAX_GAP_NS:
            self._n_gaps += 1
        else:
            dt_s, was = (t_ns - self._last[0]) * 1e-9, self._last[1]
            self._interval_s += (dt_s - self._interval_s) / NOISE_TAU
        now = integrated(
            rotation, accel_m_s2, GRAVITY_NED_M_S2, was, dt_s, self._velocity, self._displacement
        )
        self._last = t_ns, now
        if self._series.takes(t_ns):
            self._series.add(t_ns, self._newest_sums())

    def _newest_sums(self) -> Array:
        """Rows (9, 3) as of `at`."""
        out = np.empty((9, 3))
        out[0], out[1] = self._velocity[0] + self._lever[0], self._displacement[0] + self._lever[1]
        out[2:5], out[5:8], out[8] = self._velocity[1:], self._displacement[1:], self._n_gaps
        return out
