"""Autopilot boot time on the flight's clock: offset and drift from TIMESYNC or from least delays.

Time on the flight's (host) clock is `host = remote + offset(remote)`. Two things are known of the
offset. An exchange, sent at `send`, answered at `remote` and received at `receive`, puts it
half-way between `send - remote` and `receive - remote`, wrong by half its round trip at most. Any
stamped message bounds it from above by `receive - remote`: nothing arrives before it is sent. In
each window of time the exchange with the shortest round trip and the message with the least delay
are kept, and a smooth curve is laid through them. How stiff that curve is the data decide
(smoothing by second differences, Whittaker 1923; stiffness by generalised cross-validation, Craven
and Wahba 1979): a steady crystal gives a line, a simulator on a busy machine a bent one.
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
"""A step back of autopilot time by more than this is a reboot; less is a message overtaken."""
WINDOW_S = 2.0
MAX_WINDOWS = 60
MIN_SIGMA_S = 1e-4
"""Trust in the best of exchanges: stamps are made by software at both ends."""
ABSURD_NS, ABSURD_DRIFT = 60_000_000_000, 0.05
FIX_LATENCY_S = 0.1
"""What GPS receivers and drivers typically take from the time of a fix to its place in a log."""
HUBER = 1.5
LATE_DISCOUNT = 0.3
"""Least delays err to one side only: one that is late tells less than one that is early."""


class BootSegments:
    """Counts the autopilot's reboots in a stream of its stamps."""

    def __init__(self) -> None:
        self._latest_ns = -(2**62)
        self._segment = 0

    def segment_of(self, remote_ns: int) -> int:
        """The segment of a stamp, given in order of arrival; reboots so far."""
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
        """The curve of the same clocks when both run backwards."""
        return _Curve(
            -self.origin_ns, -self.base_ns, -self.knots_s[::-1], -self.offset_s[::-1],
            self.slope, self.sigma_s,
        )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class ClockMap:
    """From autopilot time to the flight's clock, for each segment between reboots."""

    report: ClockReport
    _curves: dict[int, _Curve]

    def host_ns(self, remote_ns: NDArray[Any], segment: NDArray[Any] | int) -> Times:
        """Times on the flight's clock, (N,) of autopilot times (N,) in segment(s); sorted or not.

        Raises KeyError for a segment that nothing was known of.
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
    time at its beginning, `drift_ppm` how much faster than the host's clock the autopilot's runs.
    """
    pairs = np.asarray(exchanges, np.int64).reshape(-1, 4)
    singles = np.asarray(one_way, np.int64).reshape(-1, 3)
    round_trip = pairs[:, 2] - pairs[:, 0]
    pairs = pairs[round_trip >= 0]
    # the answers to exchanges are stamped messages like any other
    singles = np.concatenate([singles, pairs[:, 1:]])
    if not len(singles):
        return None
    numbers, counts = np.unique(singles[:, 2], return_counts=True)
    curves = {}
    with_exchanges = {}
    for number in numbers:
        mine = pairs[pairs[:, 3] == number]
        curves[int(number)] = _fit(mine, _credible(singles[singles[:, 2] == number]))
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
    """Estimate the clock from UTC that a log itself holds, as by GPS; None where it holds none.

    `stamps` (N, 2): autopilot time under which a fix was logged, UTC of the fix, in ns. A fix is
    logged some time after it is valid, so the offset is above all of them by at least the least of
    these delays, which cannot be seen and is counted in the uncertainty.
    """
    table = np.asarray(stamps, np.int64).reshape(-1, 2)
    if not len(table):
        return None
    # seen in reversed time the fix is a message that comes after its stamp
    singles = np.c_[-table, np.zeros(len(table), np.int64)]
    curve = _fit(np.empty((0, 4), np.int64), _credible(singles)).reversed()
    report = ClockReport(
        method="UTC of the log",
        offset_s=float((curve.base_ns + curve.offset_s[0] * 1e9) * 1e-9),
        drift_ppm=round(float(-1e6 * curve.slope / (1 + curve.slope)), 3) + 0.0,
        sigma_ms=1e3 * float(np.hypot(curve.sigma_s, FIX_LATENCY_S)),
        n_reboots=0,
    )
    return ClockMap(report, {0: curve})


def _credible(singles: Times) -> Times:
    """Those whose delay is not absurd: a damaged stamp may be off by years."""
    delay_ns = singles[:, 1] - singles[:, 0]
    away_ns = np.abs(delay_ns - np.sort(delay_ns)[len(delay_ns) // 2])
    credible: Times = singles[away_ns <= ABSURD_NS + ABSURD_DRIFT * float(np.ptp(singles[:, 0]))]
    return credible


def _fit(pairs: Times, singles: Times) -> _Curve:
    origin_ns = int(singles[:, 0].min())
    base_ns = int((singles[:, 1] - singles[:, 0]).min())
    t_s = _seconds(singles[:, 0] - origin_ns)
    delay_s = _seconds(singles[:, 1] - singles[:, 0] - base_ns)
    window_s = max(WINDOW_S, float(t_s.max()) / MAX_WINDOWS)
    knots: Array = (np.arange(int(t_s.max() / window_s) + 1, dtype=np.float64) + 0.5) * window_s
    envelope, scatter = _envelope(t_s, delay_s, knots, window_s)
    # what the least delay itself is cannot be seen from one side; others exceed it by about as much
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
        # causality: where the envelope is lower, the autopilot was slow to answer
        offset = np.minimum(exchanged, envelope)
        parts = [scatter, np.median(sigma) / np.sqrt(3), np.median(exchanged - offset)]
        sigma_s = float(np.linalg.norm(parts))
    slope = float(np.polyfit(knots, offset, 1)[0]) if len(knots) > 2 else 0.0
    return _Curve(origin_ns, base_ns, knots, offset, slope, max(sigma_s, MIN_SIGMA_S))


def _seconds(ns: Times) -> Array:
    return ns.astype(np.float64) * 1e-9


def _envelope(t_s: Array, delay_s: Array, knots: Array, window_s: float) -> tuple[Array, float]:
    """Smooth curve along the least delays, and the scatter of these about it."""
    trend, scatter = np.zeros(len(knots)), 0.0
    for _ in range(3):  # a least delay is only found where the drift within the window is out
        level = delay_s - np.interp(t_s, knots, trend)
        best = _least_of_windows(level, t_s, window_s)
        spread = max(float(np.median(np.abs(level - np.median(level)))), MIN_SIGMA_S)
        trend, scatter = smooth(
            t_s[best], delay_s[best], np.full(len(best), spread), knots, one_sided=True
        )
    return trend, scatter


def _least_of_windows(value: Array, t_s: Array, window_s: float) -> NDArray[np.intp]:
    """Index of the least value in each window that holds any."""
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

    A constant where there are fewer than three values. With `one_sided` values above the curve
    count for less than those below.
    """
    if len(t_s) < 3 or len(knots_s) < 3:
        lowest = float(value_s.min() if one_sided else np.average(value_s, weights=sigma_s**-2))
        return np.full(len(knots_s), lowest), 0.0
    basis = _hat_functions(t_s, knots_s)
    bend = np.diff(np.eye(len(knots_s)), n=2, axis=0)
    stiffness = bend.T @ bend
    weight = (sigma_s.min() / sigma_s) ** 2
    line = np.polyfit(t_s, value_s, 1, w=np.sqrt(weight))
    curve: Array = line[0] * knots_s + line[1]
    for _ in range(5):
        residual = value_s - basis @ curve
        scale = max(1.4826 * float(np.median(np.abs(residual))), 1e-6)
        doubt = np.maximum(np.abs(residual) / (HUBER * scale), 1.0)
        if one_sided:
            doubt = np.where(residual > 0, doubt / LATE_DISCOUNT, doubt)
        curve = _cross_validated(basis, stiffness, weight / doubt, value_s)
    residual = value_s - basis @ curve
    return curve, 1.4826 * float(np.median(np.abs(residual)))


def _hat_functions(t_s: Array, knots_s: Array) -> Array:
    """(N, K) that takes values at knots to values at t_s, linear in between and beyond the ends."""
    step = knots_s[1] - knots_s[0]
    place = (t_s - knots_s[0]) / step
    left = np.clip(np.floor(place).astype(np.int64), 0, len(knots_s) - 2)
    share = place - left
    basis = np.zeros((len(t_s), len(knots_s)))
    rows = np.arange(len(t_s))
    basis[rows, left] = 1 - share
    basis[rows, left + 1] = share
    return basis


def _cross_validated(basis: Array, stiffness: Array, weight: Array, value_s: Array) -> Array:
    """The curve of that stiffness which predicts best what was left out."""
    information = (basis * weight[:, None]).T @ basis
    right = (basis * weight[:, None]).T @ value_s
    # one decomposition serves all penalties: information + p * stiffness is
    # root (1 + (p - 1) turn diag(bends) turn') root'
    root = np.linalg.cholesky(information + stiffness)
    half = np.linalg.solve(root, stiffness)
    bends, turn = np.linalg.eigh(np.linalg.solve(root, half.T))
    bends = np.clip(bends, 0.0, 1.0)
    along = turn.T @ np.linalg.solve(root, right)
    back = np.linalg.solve(root.T, turn)
    n = len(value_s)
    level = float((weight * value_s).sum() / weight.sum())
    best: Array = np.full(basis.shape[1], level)
    best_score = n * float((weight * (value_s - level) ** 2).sum()) / (n - 1.4) ** 2
    for penalty in 10.0 ** np.arange(9, -2, -1):  # of equals the stiffest, which is a constant
        gain = 1 / (1 + (penalty - 1) * bends)
        curve = back @ (gain * along)
        freedom = n - 1.4 * float((gain * (1 - bends)).sum())
        if freedom <= 0:
            continue
        score = n * float((weight * (value_s - basis @ curve) ** 2).sum()) / freedom**2
        if score < best_score * (1 - 1e-6):
            best_score, best = score, curve
    return best
