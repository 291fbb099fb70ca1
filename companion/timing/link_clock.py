"""Online clock synchronisation with an autopilot: the live counterpart of `log_clock`.

An exchange, sent at `send`, answered at `remote` and received at `receive`, puts the offset (host
minus remote) half-way between `send - remote` and `receive - remote`; the exchange of shortest
round trip in each bin is kept and weighted by its excess over the minimum. Without answers, stamped
messages bound the offset from above, and minimum delays are used. A line is fitted to the newest
points, over a window chosen by intersection of confidence intervals (Goldenshluger and Nemirovski
1997): half a minute for a crystal, a second or two for a simulator on a loaded machine.

The resulting time follows the line without steps and never goes back; only errors above `STEP_NS`
are corrected at once.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from companion.geometry.transforms import Array
from companion.messages import ClockReport

REBOOT_NS = 1_000_000_000
"""A larger step back of autopilot time is a reboot; a smaller one a reordered message."""
STEP_NS = 250_000_000
"""Larger errors are corrected at once, smaller ones slewed."""
SLEW_S, MAX_SLEW = 0.2, 0.5
"""Shortest duration of a correction, and largest relative rate change by it."""
BIN_NS = 200_000_000
LENGTHS_S = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
CONFIDENCE = 3.0
SCATTERS_S = (0.0, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2, 2e-2, 5e-2, 0.1)
"""Candidate jitters of a clock: simulators pause and catch up."""
MIN_SIGMA_S = 1e-4
"""Lower bound for exchanges: both ends stamp in software."""
STAMP_S = 1e-3
"""Resolution of most stamps: milliseconds."""
PRIOR_DRIFT = 0.02
"""Prior standard deviation of the drift: simulators on a loaded machine."""
HUBER, ROUNDS = 1.5, 3
"""Sigmas beyond which a point counts less, and fits of a line with weights by the one before."""
PROOF_NS, PROOF_WITH_ANSWERS_NS, PROOF_N = 400_000_000, 1_000_000_000, 5
"""Time and stamps after which another clock is accepted; longer where answers would show it sooner.
"""
ANSWERS_NS = 3_000_000_000
ONE_WAY_NS = 500_000_000
"""Minimum delays are used after this time."""
WINDOW_NS = 32_000_000_000
N_EXCESSES = 200


class _Point(NamedTuple):
    """The best point of a bin: offset, and the cost it was chosen by.

    `cost_ns` is half the round trip of an exchange, or the delay of a message.
    """

    remote_ns: int
    offset_ns: float
    cost_ns: int


class _Line(NamedTuple):
    """Offset now, its slope, and one standard deviation."""

    offset_ns: float
    slope: float
    sigma_ns: float


@dataclass(slots=True)
class _OtherClock:
    """Stamps inconsistent with the current clock, but consistent with each other."""

    first_ns: int
    offset_ns: int
    n: int = 1


class ClockFilter:
    """Clock of one autopilot, updated online. Not thread-safe."""

    def __init__(self) -> None:
        self.drift_ppm = 0.0
        """Rate of the autopilot's clock relative to the host's."""
        self.sigma_ns = math.inf
        """One standard deviation of `host_ns` now."""
        self.n_reboots = 0
        self.n_segments = 0
        """Clocks so far, the current one included; a reboot starts a new one."""
        self._reset()

    def _reset(self) -> None:
        self._answers: deque[_Point] = deque(maxlen=1 + WINDOW_NS // BIN_NS)
        self._delays: deque[_Point] = deque(maxlen=1 + WINDOW_NS // BIN_NS)
        self._excess_ns: deque[int] = deque(maxlen=N_EXCESSES)
        """Excess delays of the newest messages over the minimum."""
        self._latest_ns: int | None = None
        """The latest stamp of the current clock."""
        self._n = 0
        self._first_receive_ns = 0
        self._heard_ns = 0
        self._await_ns = 0
        """Until when answers are awaited before minimum delays replace them."""
        self._other_clock: _OtherClock | None = None
        self._slope = 0.0
        self._line: tuple[int, int] | None = None
        """A remote time, and the host time there, of the current line."""
        self._slew_error_ns, self._slew_ns = 0.0, 1.0
        """Lag of the output behind that line there, and the duration of its correction."""
        self._fit_sigma_ns = math.inf
        self.sigma_ns = math.inf

    # -- what comes in ---------------------------------------------------------------------------

    def exchange(self, send_ns: int, remote_ns: int, receive_ns: int) -> None:
        """Add an exchange; the answer must be known to belong to the question."""
        if receive_ns < send_ns:
            return
        expected_ns = self.host_ns(remote_ns)
        if expected_ns is not None and not (
            send_ns - REBOOT_NS <= expected_ns <= receive_ns + REBOOT_NS
        ):
            self._switch_clock(remote_ns, receive_ns)
        self._count(remote_ns, receive_ns)
        self._await_ns = receive_ns + ANSWERS_NS
        half_ns = (receive_ns - send_ns) // 2
        offset_ns = float(send_ns + half_ns - remote_ns)
        better = _keep_best(self._answers, _Point(remote_ns, offset_ns, half_ns))
        self._add_delay(remote_ns, receive_ns)
        if better or self._line is None:
            self._update_line(remote_ns)

    def one_way(self, remote_ns: int, receive_ns: int) -> bool:
        """Add a stamped message. False: its stamp is not of the current clock."""
        expected_ns = self.host_ns(remote_ns)
        if not self._is_current(remote_ns, receive_ns, expected_ns):
            if not self._other_clock_proven(remote_ns, receive_ns):
                return False
            self._switch_clock(remote_ns, receive_ns)
            expected_ns = None
        self._other_clock = None
        self._count(remote_ns, receive_ns)
        if expected_ns is not None:
            self._excess_ns.append(max(0, receive_ns - expected_ns))
        better = self._add_delay(remote_ns, receive_ns)
        since_ns = max(self._first_receive_ns + ONE_WAY_NS, self._await_ns)
        if better and receive_ns >= since_ns:
            self._update_line(remote_ns)
        return True

    # -- what goes out ---------------------------------------------------------------------------

    def host_ns(self, remote_ns: int) -> int | None:
        """Flight time of a time of the current autopilot clock; None until known."""
        if self._line is None:
            return None
        anchor_ns, host_ns = self._line
        passed_ns = remote_ns - anchor_ns
        slew_left = min(1.0, max(0.0, 1 - passed_ns / self._slew_ns))
        return (
            host_ns + passed_ns + round(self._slope * passed_ns - self._slew_error_ns * slew_left)
        )

    def report(self) -> ClockReport | None:
        """State of synchronisation; None until known. `offset_s` is host minus autopilot."""
        if self._line is None:
            return None
        anchor_ns, host_ns = self._line
        return ClockReport(
            method="TIMESYNC" if self._answers else "least delay",
            offset_s=(host_ns - anchor_ns) * 1e-9,
            drift_ppm=round(self.drift_ppm, 3),
            sigma_ms=self.sigma_ns * 1e-6,
            n_reboots=self.n_reboots,
        )

    # -- which clock it is -----------------------------------------------------------------------

    def _is_current(self, remote_ns: int, receive_ns: int, expected_ns: int | None) -> bool:
        if self._latest_ns is None:
            return True
        if remote_ns < self._latest_ns - REBOOT_NS:
            return False
        if expected_ns is None:  # no line yet: only a coarse check
            passed_ns = receive_ns - self._first_receive_ns
            return remote_ns < self._latest_ns + passed_ns + REBOOT_NS
        return expected_ns <= receive_ns + REBOOT_NS

    def _other_clock_proven(self, remote_ns: int, receive_ns: int) -> bool:
        """True if inconsistent stamps have indicated another clock for long enough."""
        offset_ns = receive_ns - remote_ns
        seen = self._other_clock
        if seen is None or abs(offset_ns - seen.offset_ns) > REBOOT_NS:
            self._other_clock = _OtherClock(receive_ns, offset_ns)
            return False
        seen.n += 1
        proof_ns = PROOF_WITH_ANSWERS_NS if receive_ns < self._await_ns else PROOF_NS
        return seen.n >= PROOF_N and receive_ns - seen.first_ns >= proof_ns

    def _switch_clock(self, remote_ns: int, receive_ns: int) -> None:
        """Switch to another clock; count a reboot where it is set back against the host."""
        expected_ns = self.host_ns(remote_ns)
        set_back = self._latest_ns is not None and remote_ns < self._latest_ns - REBOOT_NS
        set_back |= expected_ns is not None and expected_ns < receive_ns - REBOOT_NS
        if set_back and self._n >= PROOF_N:
            self.n_reboots += 1
        self._reset()

    def _count(self, remote_ns: int, receive_ns: int) -> None:
        if self._n == 0:
            self.n_segments += 1
            self._first_receive_ns = receive_ns
        elif self._await_ns and receive_ns - self._heard_ns > REBOOT_NS:
            self._await_ns = receive_ns + ANSWERS_NS  # after a silence, await answers again
        self._n += 1
        self._heard_ns = receive_ns
        self._latest_ns = max(self._latest_ns or remote_ns, remote_ns)

    # -- where it stands -------------------------------------------------------------------------

    def _add_delay(self, remote_ns: int, receive_ns: int) -> bool:
        # remove drift within the bin, which would count as delay
        level_ns = round(receive_ns - remote_ns - self._slope * (remote_ns % BIN_NS))
        return _keep_best(self._delays, _Point(remote_ns, float(receive_ns - remote_ns), level_ns))

    def _update_line(self, now_ns: int) -> None:
        """Fit new lines and slew to the lower one."""
        now_ns = max(now_ns, self._latest_ns or now_ns)
        for points in (self._answers, self._delays):
            while points and now_ns - points[0].remote_ns > WINDOW_NS:
                points.popleft()
        line = self._line_of(self._delays, now_ns, np.full(len(self._delays), STAMP_S))
        if not self._answers:
            # the minimum delay is unobservable; the excess of others indicates its size
            excess_ns = _median(sorted(self._excess_ns)) if self._excess_ns else 0.0
            systematic_ns = math.hypot(1e9 * STAMP_S, excess_ns)
        else:
            half_ns = np.array([each.cost_ns for each in self._answers])
            least_ns = float(half_ns.min())
            sigma_s = np.maximum(1e-9 * (half_ns - least_ns), MIN_SIGMA_S)
            exchanged = self._line_of(self._answers, now_ns, sigma_s)
            # causality: where minimum delays are lower, the autopilot answered late
            slow_ns = max(0.0, exchanged.offset_ns - line.offset_ns)
            systematic_ns = math.hypot(least_ns / math.sqrt(3), 0.5 * slow_ns)
            line = exchanged._replace(offset_ns=exchanged.offset_ns - slow_ns)
        self._fit_sigma_ns = math.hypot(line.sigma_ns, systematic_ns)
        self._slew_to(now_ns, now_ns + round(line.offset_ns), line.slope)

    def _line_of(self, points: deque[_Point], now_ns: int, sigma_s: Array) -> _Line:
        base_ns = points[-1].offset_ns
        t_s = (np.array([each.remote_ns for each in points]) - now_ns) * 1e-9
        offset_s = (np.array([each.offset_ns for each in points]) - base_ns) * 1e-9
        value_s, slope, spread_s = _line_at_end(t_s, offset_s, sigma_s)
        return _Line(base_ns + 1e9 * value_s, slope, 1e9 * spread_s)

    def _slew_to(self, remote_ns: int, host_ns: int, slope: float) -> None:
        standing_ns = self.host_ns(remote_ns)
        error_ns = 0.0 if standing_ns is None else float(host_ns - standing_ns)
        if abs(error_ns) > STEP_NS:
            error_ns = 0.0
        self._line, self._slope = (remote_ns, host_ns), slope
        self._slew_error_ns = error_ns
        self._slew_ns = max(SLEW_S * 1e9, abs(error_ns) / MAX_SLEW)
        self.drift_ppm = -1e6 * slope / (1 + slope)
        self.sigma_ns = math.hypot(self._fit_sigma_ns, error_ns)


def _keep_best(points: deque[_Point], point: _Point) -> bool:
    """Keep the best point of each bin, in order of time; whether this is one."""
    number, newest = point.remote_ns // BIN_NS, points[-1] if points else None
    if newest is None or newest.remote_ns // BIN_NS < number:
        points.append(point)
        return True
    if newest.remote_ns // BIN_NS == number and point.cost_ns < newest.cost_ns:
        points[-1] = point
        return True
    return False


def _line_at_end(t_s: Array, value_s: Array, sigma_s: Array) -> tuple[float, float, float]:
    """Value at time 0, slope and standard deviation of the value, over the selected window.

    `t_s` (N,) in order; each window has its newest.
    """
    low, high = -math.inf, math.inf
    best: tuple[float, float, float] | None = None
    n_before = 0
    sigma_s = np.hypot(sigma_s, _scatter(t_s, value_s, sigma_s))
    moments = np.stack([np.ones(len(t_s)), t_s, t_s**2, value_s, t_s * value_s])
    by_sigma = sigma_s**-2
    for begin in np.searchsorted(t_s, [-each for each in LENGTHS_S]).tolist():
        n = len(t_s) - begin
        if n == n_before:
            continue
        n_before = n
        found = _robust_line(moments[:, begin:], sigma_s[begin:], by_sigma[begin:])
        margin = CONFIDENCE * found[2]
        low, high = max(low, found[0] - margin), min(high, found[0] + margin)
        if low > high and best is not None:
            break
        best = found
    assert best is not None
    return best


def _scatter(t_s: Array, value_s: Array, sigma_s: Array) -> float:
    """Scatter of neighbours beyond their sigmas, insensitive to curvature."""
    if len(t_s) < 5:
        return 0.0
    share = (t_s[1:-1] - t_s[:-2]) / (t_s[2:] - t_s[:-2])
    second_difference = np.abs(value_s[1:-1] - (1 - share) * value_s[:-2] - share * value_s[2:])
    expected = sigma_s[1:-1] ** 2 + 0.25 * (sigma_s[:-2] ** 2 + sigma_s[2:] ** 2)
    for scatter_s in SCATTERS_S:
        if (
            1.4826 * _median(np.sort(second_difference / np.sqrt(expected + 1.5 * scatter_s**2)))
            <= 1
        ):
            break
    return scatter_s


def _median(ordered: Sequence[float] | Array) -> float:
    """Median of numbers in order; numpy's own takes ten times as long for so few."""
    n = len(ordered)
    return float((ordered[(n - 1) // 2] + ordered[n // 2]) / 2)


def _robust_line(moments: Array, sigma_s: Array, by_sigma: Array) -> tuple[float, float, float]:
    """Value at time 0, slope and standard deviation; `moments` (5, N) are 1, t, t^2, v and t v."""
    t_s, value_s = moments[1], moments[3]
    limit_s = HUBER * sigma_s
    weight = by_sigma
    for round_ in range(ROUNDS):
        # a line with a prior on its slope, solved about time 0
        total, first, squares, *right = (moments @ weight).tolist()
        second = squares + PRIOR_DRIFT**-2
        determinant = total * second - first**2
        offset = (second * right[0] - first * right[1]) / determinant
        slope = (total * right[1] - first * right[0]) / determinant
        if round_ < ROUNDS - 1:
            residual_s = np.abs(value_s - offset - slope * t_s)
            weight = by_sigma / np.maximum(1.0, residual_s / limit_s)
    return offset, slope, math.sqrt(second / determinant)
