"""Offline clock synchronisation: offset and drift from TIMESYNC or minimum delays.

Time on the flight (host) clock is `host = remote + offset(remote)`. An exchange, sent at `send`,
answered at `remote` and received at `receive`, puts the offset half-way between `send - remote` and
`receive - remote`, wrong by at most half the round trip. Any stamped message bounds it from above
by `receive - remote`. The exchange of shortest round trip and the message of minimum delay of each
window are kept, and a smooth curve is fitted to them: second-difference penalty (Whittaker 1923),
its weight by generalised cross-validation (Craven and Wahba 1979). A crystal gives a line, a
simulator on a loaded machine a curve.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.geometry.transforms import Array
from companion.messages import ClockReport

Times = NDArray[np.int64]

REBOOT_NS = 1_000_000_000
"""A larger step back of autopilot time is a reboot; a smaller one a reordered message."""
WINDOW_S = 2.0
MAX_WINDOWS = 60
MIN_SIGMA_S = 1e-4
"""Lower bound for exchanges: both ends stamp in software."""
MAX_DELAY_NS, MAX_DRIFT = 60_000_000_000, 0.05
FIX_LATENCY_S = 0.1
"""Typical latency of GPS receivers and drivers from a fix to its log entry."""
HUBER = 1.5
LATE_WEIGHT = 0.3
"""Minimum delays err to one side: late ones carry less information than early ones."""


class BootSegments:
    """Counts reboots of the autopilot in a stream of stamps."""

    def __init__(self) -> None:
        self._latest_ns = -(2**62)
        self._segment = 0

    def segment_of(self, remote_ns: int) -> int:
        """Segment of a stamp, given in order of arrival: reboots so far."""
        if remote_ns < self._latest_ns - REBOOT_NS:
            self._segment += 1
            self._latest_ns = remote_ns
        self._latest_ns = max(self._latest_ns, remote_ns)
        return self._segment


@dataclass(frozen=True, slots=True, eq=False)
class _Curve:
    """Offset over remote time of one segment: knots in seconds after `origin_ns`."""

    origin_ns: int
    base_ns: int
    knots_s: Array
    offset_s: Array
    slope: float
    sigma_s: float

    def host_ns(self, remote_ns: Times) -> Times:
        t_s = (remote_ns - self.origin_ns) * 1e-9
        inside = np.clip(t_s, self.knots_s[0], self.knots_s[-1])
        offset_s = np.interp(inside, self.knots_s, self.offset_s) + self.slope * (t_s - inside)
        host: Times = remote_ns + self.base_ns + np.rint(offset_s * 1e9).astype(np.int64)
        return host

    def reversed(self) -> _Curve:
        """The curve of the same clocks running backwards."""
        return _Curve(
            -self.origin_ns, -self.base_ns, -self.knots_s[::-1], -self.offset_s[::-1],
            self.slope, self.sigma_s,
        )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class ClockMap:
    """Autopilot time to flight time, for each segment between reboots."""

    report: ClockReport
    _curves: dict[int, _Curve]

    def host_ns(self, remote_ns: NDArray[Any], segment: NDArray[Any] | int) -> Times:
        """Flight times (N,) of autopilot times (N,) in segment(s), in any order.

        Raises KeyError for an unknown segment.
        """
        remote = np.atleast_1d(np.asarray(remote_ns, np.int64))
        segments = np.broadcast_to(np.asarray(segment), remote.shape)
        out = np.empty_like(remote)
        for number in np.unique(segments):
            chosen = segments == number
            out[chosen] = self._curves[int(number)].host_ns(remote[chosen])
        return out


def estimate_clock(
    exchanges: NDArray[Any] | Sequence[tuple[int, int, int, int]],
    one_way: NDArray[Any] | Sequence[tuple[int, int, int]],
) -> ClockMap | None:
    """Estimate the clock from a whole log; None where it holds no stamp.

    `exchanges` (N, 4): send, remote, receive in ns, segment. `one_way` (M, 3): remote, receive in
    ns, segment. The report is of the segment with most messages: `offset_s` is host minus autopilot
    time at its start, `drift_ppm` the rate of the autopilot's clock relative to the host's.
    """
    pairs = np.asarray(exchanges, np.int64).reshape(-1, 4)
    singles = np.asarray(one_way, np.int64).reshape(-1, 3)
    round_trip = pairs[:, 2] - pairs[:, 0]
    pairs = pairs[round_trip >= 0]
    # answers to exchanges are stamped messages too
    singles = np.concatenate([singles, pairs[:, 1:]])
    if not len(singles):
        return None
    numbers, counts = np.unique(singles[:, 2], return_counts=True)
    curves = {}
    with_exchanges = {}
    for number in numbers:
        mine = pairs[pairs[:, 3] == number]
        curves[int(number)] = _fit(mine, _plausible(singles[singles[:, 2] == number]))
        with_exchanges[int(number)] = len(mine) > 0
    main = int(numbers[int(np.argmax(counts))])
    curve = curves[main]
    report = ClockReport(
        method="TIMESYNC" if with_exchanges[main] else "least delay",
        offset_s=float((curve.base_ns + curve.offset_s[0] * 1e9) * 1e-9),
        drift_ppm=round(float(-1e6 * curve.slope / (1 + curve.slope)), 3) + 0.0,
        sigma_ms=curve.sigma_s * 1e3,
        n_reboots=len(numbers) - 1,
    )
    return ClockMap(report, curves)


def clock_from_utc(stamps: NDArray[Any] | Sequence[tuple[int, int]]) -> ClockMap | None:
    """Estimate the clock from UTC in the log itself, as by GPS; None where it holds none.

    `stamps` (N, 2): autopilot time of the log entry of a fix, UTC of the fix, in ns. A fix is
    logged some time after it is valid, so the offset exceeds all of them by at least the minimum
    latency, which is unobservable and included in sigma.
    """
    table = np.asarray(stamps, np.int64).reshape(-1, 2)
    if not len(table):
        return None
    # in reversed time a fix is a message received after its stamp
    singles = np.c_[-table, np.zeros(len(table), np.int64)]
    curve = _fit(np.empty((0, 4), np.int64), _plausible(singles)).reversed()
    report = ClockReport(
        method="UTC of the log",
        offset_s=float((curve.base_ns + curve.offset_s[0] * 1e9) * 1e-9),
        drift_ppm=round(float(-1e6 * curve.slope / (1 + curve.slope)), 3) + 0.0,
        sigma_ms=1e3 * float(np.hypot(curve.sigma_s, FIX_LATENCY_S)),
        n_reboots=0,
    )
    return ClockMap(report, {0: curve})


def _plausible(singles: Times) -> Times:
    """Messages of plausible delay: a corrupt stamp may be off by years."""
    delay_ns = singles[:, 1] - singles[:, 0]
    deviation_ns = np.abs(delay_ns - np.sort(delay_ns)[len(delay_ns) // 2])
    plausible: Times = singles[
        deviation_ns <= MAX_DELAY_NS + MAX_DRIFT * float(np.ptp(singles[:, 0]))
    ]
    return plausible


def _fit(pairs: Times, singles: Times) -> _Curve:
    origin_ns = int(singles[:, 0].min())
    base_ns = int((singles[:, 1] - singles[:, 0]).min())
    t_s = _seconds(singles[:, 0] - origin_ns)
    delay_s = _seconds(singles[:, 1] - singles[:, 0] - base_ns)
    window_s = max(WINDOW_S, float(t_s.max()) / MAX_WINDOWS)
    knots: Array = (np.arange(int(t_s.max() / window_s) + 1, dtype=np.float64) + 0.5) * window_s
    envelope, scatter = _envelope(t_s, delay_s, knots, window_s)
    # the minimum delay is unobservable; the excess of others indicates its size
    excess_s = delay_s - np.interp(t_s, knots, envelope)
    sigma_s = float(np.hypot(scatter, np.median(excess_s)))
    offset = envelope
    if len(pairs):
        t_pair = _seconds(pairs[:, 1] - origin_ns)
        half_s = 0.5 * _seconds(pairs[:, 2] - pairs[:, 0])
        middle_s = _seconds(pairs[:, 0] - pairs[:, 1] - base_ns) + half_s
        best = _least_of_windows(half_s, t_pair, window_s)
        sigma = np.maximum(half_s[best], MIN_SIGMA_S)
        exchanged, scatter = smooth(t_pair[best], middle_s[best], sigma, knots)
        # causality: where the envelope is lower, the autopilot answered late
        offset = np.minimum(exchanged, envelope)
        parts = [scatter, np.median(sigma) / np.sqrt(3), np.median(exchanged - offset)]
        sigma_s = float(np.linalg.norm(parts))
    slope = float(np.polyfit(knots, offset, 1)[0]) if len(knots) > 2 else 0.0
    return _Curve(origin_ns, base_ns, knots, offset, slope, max(sigma_s, MIN_SIGMA_S))


def _seconds(ns: Times) -> Array:
    return ns.astype(np.float64) * 1e-9


def _envelope(t_s: Array, delay_s: Array, knots: Array, window_s: float) -> tuple[Array, float]:
    """Smooth curve along the minimum delays, and their scatter about it."""
    trend, scatter = np.zeros(len(knots)), 0.0
    for _ in range(3):  # minimum delays require the drift within the window to be removed
        level = delay_s - np.interp(t_s, knots, trend)
        best = _least_of_windows(level, t_s, window_s)
        spread = max(float(np.median(np.abs(level - np.median(level)))), MIN_SIGMA_S)
        trend, scatter = smooth(
            t_s[best], delay_s[best], np.full(len(best), spread), knots, one_sided=True
        )
    return trend, scatter


def _least_of_windows(value: Array, t_s: Array, window_s: float) -> NDArray[np.intp]:
    """Index of the minimum in each non-empty window."""
    window = np.floor(t_s / window_s).astype(np.int64)
    order = np.lexsort((value, window))
    first = np.ones(len(order), bool)
    first[1:] = np.diff(window[order]) > 0
    chosen: NDArray[np.intp] = order[first]
    return chosen


def smooth(
    t_s: Array, value_s: Array, sigma_s: Array, knots_s: Array, *, one_sided: bool = False
) -> tuple[Array, float]:
    """Robust smooth curve at evenly spaced knots through values (N,), and their scatter about it.

    A constant for fewer than three values. With `one_sided` values above the curve have less
    weight.
    """
    if len(t_s) < 3 or len(knots_s) < 3:
        lowest = float(value_s.min() if one_sided else np.average(value_s, weights=sigma_s**-2))
        return np.full(len(knots_s), lowest), 0.0
    basis = _hat_functions(t_s, knots_s)
    second_difference = np.diff(np.eye(len(knots_s)), n=2, axis=0)
    stiffness = second_difference.T @ second_difference
    weight = (sigma_s.min() / sigma_s) ** 2
    line = np.polyfit(t_s, value_s, 1, w=np.sqrt(weight))
    curve: Array = line[0] * knots_s + line[1]
    for _ in range(5):
        residual = value_s - basis @ curve
        scale = max(1.4826 * float(np.median(np.abs(residual))), 1e-6)
        inverse_weight = np.maximum(np.abs(residual) / (HUBER * scale), 1.0)
        if one_sided:
            inverse_weight = np.where(residual > 0, inverse_weight / LATE_WEIGHT, inverse_weight)
        curve = _cross_validated(basis, stiffness, weight / inverse_weight, value_s)
    residual = value_s - basis @ curve
    return curve, 1.4826 * float(np.median(np.abs(residual)))


def _hat_functions(t_s: Array, knots_s: Array) -> Array:
    """(N, K) linear interpolation from knots to t_s, extrapolating beyond the ends."""
    step = knots_s[1] - knots_s[0]
    position = (t_s - knots_s[0]) / step
    left = np.clip(np.floor(position).astype(np.int64), 0, len(knots_s) - 2)
    share = position - left
    basis = np.zeros((len(t_s), len(knots_s)))
    rows = np.arange(len(t_s))
    basis[rows, left] = 1 - share
    basis[rows, left + 1] = share
    return basis


def _cross_validated(basis: Array, stiffness: Array, weight: Array, value_s: Array) -> Array:
    """The curve whose stiffness minimises generalised cross-validation."""
    information = (basis * weight[:, None]).T @ basis
    right = (basis * weight[:, None]).T @ value_s
    # one decomposition serves all penalties: information + p * stiffness is
    # cholesky (1 + (p - 1) eigenvectors diag(eigenvalues) eigenvectors') cholesky'
    cholesky = np.linalg.cholesky(information + stiffness)
    half = np.linalg.solve(cholesky, stiffness)
    eigenvalues, eigenvectors = np.linalg.eigh(np.linalg.solve(cholesky, half.T))
    eigenvalues = np.clip(eigenvalues, 0.0, 1.0)
    along = eigenvectors.T @ np.linalg.solve(cholesky, right)
    back = np.linalg.solve(cholesky.T, eigenvectors)
    n = len(value_s)
    level = float((weight * value_s).sum() / weight.sum())
    best: Array = np.full(basis.shape[1], level)
    best_score = n * float((weight * (value_s - level) ** 2).sum()) / (n - 1.4) ** 2
    for penalty in 10.0 ** np.arange(9, -2, -1):  # ties resolve to the stiffest, a constant
        gain = 1 / (1 + (penalty - 1) * eigenvalues)
        curve = back @ (gain * along)
        freedom = n - 1.4 * float((gain * (1 - eigenvalues)).sum())
        if freedom <= 0:
            continue
        score = n * float((weight * (value_s - basis @ curve) ** 2).sum()) / freedom**2
        if score < best_score * (1 - 1e-6):
            best_score, best = score, curve
    return best
