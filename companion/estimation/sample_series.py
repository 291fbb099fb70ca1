"""Time series of measurements, with interpolation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from companion.geometry.transforms import Array

MAX_GAP_NS = 1_500_000_000
SAME_TIME_NS = 1_000_000
"""A sample at the time of a frame, as of photographs, needs no neighbour."""
MIN_SPACING_NS = 45_000_000


class SampleSeries:
    """Samples over time with a minimum spacing."""

    def __init__(self) -> None:
        self._n = 0
        self._times: NDArray[np.int64] = np.zeros(256, np.int64)
        self._values: Array = np.zeros(0)

    @property
    def newest(self) -> tuple[int, Array] | None:
        """Time and value of the last sample."""
        last = self._n - 1
        return (int(self._times[last]), self._values[last]) if self._n else None

    def takes(self, t_ns: int) -> bool:
        """True unless a sample at a time is too close to the last one."""
        return self._n == 0 or int(self._times[self._n - 1]) + MIN_SPACING_NS <= t_ns

    def add(self, t_ns: int, value: Array, horizontal_only: bool = False) -> None:
        """Add a sample of any shape; invalid or too closely spaced ones are dropped."""
        known = value[..., :2] if horizontal_only else value
        if not self.takes(t_ns) or not np.isfinite(known).all():
            return
        if not self._n:
            self._values = np.zeros((len(self._times), *value.shape))
        elif self._n == len(self._times):
            self._times = np.concatenate([self._times, np.zeros_like(self._times)])
            self._values = np.concatenate([self._values, np.zeros_like(self._values)])
        self._times[self._n], self._values[self._n] = t_ns, value
        self._n += 1

    def prune(self, before_ns: int, keep_at: Array) -> None:
        """Drop samples before a time, except those around the times `keep_at` (N,), sorted.

        At these times, and after `before_ns`, interpolation is unchanged.
        """
        times = self._times[: self._n]
        old = int(np.searchsorted(times, before_ns)) - 1  # later times may lie between two
        if old <= 0:
            return
        keep = np.zeros(self._n, bool)
        keep[old:] = True
        i = np.clip(np.searchsorted(times, keep_at), 1, max(self._n - 1, 1))
        keep[i] = keep[i - 1] = True
        n = int(np.count_nonzero(keep))
        self._times[:n], self._values[:n] = times[keep], self._values[: self._n][keep]
        self._n = n

    def drop_since(self, t_ns: int) -> None:
        """Drop samples from a time on."""
        self._n = int(np.searchsorted(self._times[: self._n], t_ns))

    def at(self, t_ns: Array | NDArray[np.int64]) -> tuple[Array, NDArray[np.bool_]]:
        """Interpolated values, and a mask of times with samples near enough on both sides."""
        times, values = self._times[: self._n], self._values[: self._n]
        i = np.clip(np.searchsorted(times, t_ns), 1, len(times) - 1)
        span = times[i] - times[i - 1]
        f = ((t_ns - times[i - 1]) / np.maximum(span, 1)).reshape(-1, *([1] * (values.ndim - 1)))
        nearest = np.minimum(np.abs(t_ns - times[i - 1]), np.abs(times[i] - t_ns))
        covered = (span < MAX_GAP_NS) | (nearest <= SAME_TIME_NS)
        inside = (t_ns >= times[0]) & (t_ns <= times[-1]) & covered
        return values[i - 1] * (1 - f) + values[i] * f, inside

    def __len__(self) -> int:
        return self._n
