"""Turns of the body by its gyroscopes: the integral of their rates."""

from __future__ import annotations

from math import isfinite

import numpy as np
from numpy.typing import NDArray

from companion.geometry.transforms import Array
from companion.slam.compiled.inertial_steps import turned
from companion.telemetry import ImuSample

MAX_GAP_NS = 100_000_000
"""Longer without a sample, nothing is integrated across."""
MAX_SAMPLES = 32768
"""Nearly three minutes at 200 a second, 3 MB; the older half goes when they are full."""
_IDENTITY = np.eye(3)
TAU, REGULAR = 500, 0.2
"""Samples over which interval and noise are averaged; by which ratio of the interval stamps of
samples that come regularly are off, by an autopilot's scheduler and corrections of the clock."""


class TurnIntegral:
    """Rotations at the times of the samples, in axes of the body at the first."""

    def __init__(self) -> None:
        self.interval_s = 0.0
        """Of samples that come regularly."""
        self._variance, self._change = 0.0, np.zeros(3)
        """White noise of the rates, as a density; their change between the last two."""
        self._n = 0
        self._t_ns = np.zeros(MAX_SAMPLES, np.int64)
        self._rotations = np.zeros((MAX_SAMPLES, 3, 3))
        self._rates = np.zeros((MAX_SAMPLES, 3))
        self._gaps = np.zeros(MAX_SAMPLES, np.int64)
        """Number of gaps before each."""

    def take(self, sample: ImuSample) -> None:
        """Add a sample, in order of time; others are left out."""
        rates, last = sample.gyro_rad_s, self._n - 1
        if (self._n and sample.t_ns <= self._t_ns[last]) or not all(map(isfinite, rates.tolist())):
            return
        if self._n == MAX_SAMPLES:
            half = MAX_SAMPLES // 2
            for each in (self._t_ns, self._rotations, self._rates, self._gaps):
                each[:half] = each[half:]
            self._n, last = half, half - 1
        rotation, gaps = _IDENTITY, 0
        if self._n:
            step_ns, gaps = sample.t_ns - int(self._t_ns[last]), int(self._gaps[last])
            rotation = self._rotations[last]
            if step_ns > MAX_GAP_NS:
                gaps += 1
            else:
                dt_s = step_ns * 1e-9
                self.interval_s = self.interval_s or dt_s
                regular = regular_s(dt_s, self.interval_s)
                if regular != dt_s:
                    self.interval_s += (dt_s - self.interval_s) / TAU
                self._see_noise(rates - self._rates[last], regular)
                rotation = turned(rotation, self._rates[last], rates, regular)
        self._t_ns[self._n], self._rotations[self._n] = sample.t_ns, rotation
        self._rates[self._n], self._gaps[self._n] = rates, gaps
        self._n += 1

    @property
    def density_rad_s(self) -> float:
        """White noise of the gyroscopes, rad/s per root of Hz, from their own differences."""
        return float(np.sqrt(self._variance))

    def withdraw(self, since_ns: int) -> None:
        """Drop what came from a time on: the samples were wrong."""
        self._n = int(np.searchsorted(self._t_ns[: self._n], since_ns))

    def _see_noise(self, change: Array, dt_s: float) -> None:
        """White noise by second differences, in which motion hardly shows at 100 Hz."""
        x, y, z = (change - self._change).tolist()
        self._change = change
        self._variance += ((x * x + y * y + z * z) / 18.0 * dt_s - self._variance) / TAU

    def at(self, t_ns: NDArray[np.int64]) -> tuple[Array, Array, NDArray[np.int64]]:
        """Rotations (N, 3, 3) and rates (N, 3) at times (N,), and the number of gaps before each.

        -1 where unknown.
        """
        if not self._n:
            n = len(t_ns)
            return np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), np.full(n, -1)
        times = self._t_ns[: self._n]
        at = np.searchsorted(times, t_ns, side="right") - 1
        since_ns = t_ns - times[at]
        known = (at >= 0) & (since_ns <= MAX_GAP_NS)
        turns = self._rates[at] * np.where(known, since_ns * 1e-9, 0.0)[:, None]
        return (
            self._rotations[at] @ rotations_from_vectors(turns), self._rates[at],
            np.where(known, self._gaps[at], -1),
        )  # fmt: skip


def regular_s(dt_s: float, interval_s: float) -> float:
    """Time between two samples: their interval, where stamps do not contradict it."""
    return interval_s if abs(dt_s - interval_s) < REGULAR * interval_s else dt_s


def rotations_from_vectors(vectors: Array) -> Array:
    """Rotations (N, 3, 3) by small rotation vectors (N, 3), to their second order."""
    x, y, z = vectors.T
    o = np.zeros_like(x)
    skews = np.stack([o, -z, y, z, o, -x, -y, x, o], 1).reshape(-1, 3, 3)
    return np.asarray(np.eye(3) + skews + 0.5 * skews @ skews, np.float64)
