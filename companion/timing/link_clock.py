"""Autopilot boot time on the flight's clock while it runs: the live counterpart of `clocksync`.

An exchange, sent at `send`, answered at `remote` and received at `receive`, puts the offset
(host minus remote) half-way between `send - remote` and `receive - remote`; of each moment that of
the shortest round trip is kept and weighted by how much longer than the shortest of all it took.
Where the peer answers none, any stamped message bounds the offset from above, and the least delays
are followed. A line is laid through the newest of these. Through how many seconds of them the data
decide, by the intersection of confidence intervals (Goldenshluger and Nemirovski 1997): a steady
crystal is averaged over half a minute, a simulator on a busy machine over a second or two.

The time that is handed out follows the newest line without steps and never goes back; only an error
of more than `STEP_NS` is put right at once.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from companion.geometry.transforms import Array
from companion.messages import ClockReport

REBOOT_NS = 1_000_000_000
"""A step back of autopilot time by more than this is a reboot; less is a message overtaken."""
STEP_NS = 250_000_000
"""An error that large is put right at once, a smaller one smoothly."""
SLEW_S, MAX_SLEW = 0.2, 0.5
"""A correction takes at least so long, and changes the pace of time by at most this share."""
BIN_NS = 200_000_000
LENGTHS_S = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
CONFIDENCE = 3.0
SCATTERS_S = (0.0, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2, 2e-2, 5e-2, 0.1)
"""How much a clock may tremble: those of simulators stand still and catch up."""
MIN_SIGMA_S = 1e-4
"""Trust in the best of exchanges: stamps are made by software at both ends."""
STAMP_S = 1e-3
"""Most stamps count milliseconds."""
PRIOR_DRIFT = 0.02
"""What a clock may be wrong before anything is known of it: simulators on a loaded machine."""
HUBER = 1.5
PROOF_NS, UNSURE_PROOF_NS, PROOF_N = 400_000_000, 1_000_000_000, 5
"""A clock that runs elsewhere is believed after so long and so many stamps; the longer time is for
a peer whose answers would tell sooner."""
ANSWERS_NS = 3_000_000_000
ONE_WAY_NS = 500_000_000
"""Least delays are trusted after so long."""
FORGET_NS = 32_000_000_000
N_EXCESSES = 200


class _Point(NamedTuple):
    """What is kept of a short time: where the offset is, and by what it was chosen.

    `cost_ns` is half the round trip of an exchange, or the delay of a message.
    """

    remote_ns: int
    offset_ns: float
    cost_ns: int


class _Line(NamedTuple):
    """The offset now, how fast it changes, and one standard deviation."""

    offset_ns: float
    slope: float
    sigma_ns: float


@dataclass(slots=True)
class _Elsewhere:
    """Stamps that do not fit the running clock, yet each other."""

    first_ns: int
    offset_ns: int
    n: int = 1


class ClockFilter:
    """Times of one autopilot, given as they come. Not for several threads."""

    def __init__(self) -> None:
        self.drift_ppm = 0.0
        """How much faster than the host's clock the autopilot's runs."""
        self.sigma_ns = math.inf
        """One standard deviation of what `host_ns` hands out now."""
        self.n_reboots = 0
        self.n_segments = 0
        """Clocks so far, the running one included: after a reboot a new one begins."""
        self._begin()

    def _begin(self) -> None:
        self._answers: deque[_Point] = deque(maxlen=1 + FORGET_NS // BIN_NS)
        self._delays: deque[_Point] = deque(maxlen=1 + FORGET_NS // BIN_NS)
        self._excess_ns: deque[int] = deque(maxlen=N_EXCESSES)
        """How much longer than the least the newest messages took."""
        self._latest_ns: int | None = None
        """The latest stamp that fits."""
        self._n = 0
        self._first_receive_ns = 0
        self._heard_ns = 0
        self._await_ns = 0
        """Until then answers are waited for, before least delays are taken for them."""
        self._elsewhere: _Elsewhere | None = None
        self._slope = 0.0
        self._line: tuple[int, int] | None = None
        """A remote time, and the host's at it, of the line that is followed."""
        self._behind_ns, self._slew_ns = 0.0, 1.0
        """By how much the time handed out is behind that line there, and when it no longer is."""
        self._fit_sigma_ns = math.inf
        self.sigma_ns = math.inf

    # -- what comes in ---------------------------------------------------------------------------

    def exchange(self, send_ns: int, remote_ns: int, receive_ns: int) -> None:
        """A question sent and answered; it must be known that this answers that."""
        if receive_ns < send_ns:
            return
        expected_ns = self.host_ns(remote_ns)
        if expected_ns is not None and not (
            send_ns - REBOOT_NS <= expected_ns <= receive_ns + REBOOT_NS
        ):
            self._change(remote_ns, receive_ns)
        self._count(remote_ns, receive_ns)
        self._await_ns = receive_ns + ANSWERS_NS
        half_ns = (receive_ns - send_ns) // 2
        offset_ns = float(send_ns + half_ns - remote_ns)
        better = _keep(self._answers, _Point(remote_ns, offset_ns, half_ns))
        self._note_delay(remote_ns, receive_ns)
        if better or self._line is None:
            self._follow(remote_ns)

    def one_way(self, remote_ns: int, receive_ns: int) -> bool:
        """Any stamped message. False: its stamp is not of the running clock: replayed, wild."""
        if not self._fits(remote_ns, receive_ns):
            if not self._runs_elsewhere(remote_ns, receive_ns):
                return False
            self._change(remote_ns, receive_ns)
        self._elsewhere = None
        self._count(remote_ns, receive_ns)
        expected_ns = self.host_ns(remote_ns)
        if expected_ns is not None:
            self._excess_ns.append(max(0, receive_ns - expected_ns))
        better = self._note_delay(remote_ns, receive_ns)
        since_ns = max(self._first_receive_ns + ONE_WAY_NS, self._await_ns)
        if better and receive_ns >= since_ns:
            self._follow(remote_ns)
        return True

    # -- what goes out ---------------------------------------------------------------------------

    def host_ns(self, remote_ns: int) -> int | None:
        """The flight's time at a time of the autopilot's running clock; None until it is known."""
        if self._line is None:
            return None
        anchor_ns, host_ns = self._line
        passed_ns = remote_ns - anchor_ns
        return host_ns + passed_ns + round(self._slope * passed_ns - self._left_ns(passed_ns))

    def report(self) -> ClockReport | None:
        """How the clocks stand; None until that is known. `offset_s` is host minus autopilot."""
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

    def _fits(self, remote_ns: int, receive_ns: int) -> bool:
        if self._latest_ns is None:
            return True
        if remote_ns < self._latest_ns - REBOOT_NS:
            return False
        expected_ns = self.host_ns(remote_ns)
        if expected_ns is None:  # too early to say more than this
            passed_ns = receive_ns - self._first_receive_ns
            return remote_ns < self._latest_ns + passed_ns + REBOOT_NS
        return expected_ns <= receive_ns + REBOOT_NS

    def _runs_elsewhere(self, remote_ns: int, receive_ns: int) -> bool:
        """Whether stamps that do not fit have told of another clock for long enough."""
        offset_ns = receive_ns - remote_ns
        seen = self._elsewhere
        if seen is None or abs(offset_ns - seen.offset_ns) > REBOOT_NS:
            self._elsewhere = _Elsewhere(receive_ns, offset_ns)
            return False
        seen.n += 1
        proof_ns = UNSURE_PROOF_NS if receive_ns < self._await_ns else PROOF_NS
        return seen.n >= PROOF_N and receive_ns - seen.first_ns >= proof_ns

    def _change(self, remote_ns: int, receive_ns: int) -> None:
        """Another clock has begun; a boot sets it back, measured against the host's."""
        expected_ns = self.host_ns(remote_ns)
        set_back = self._latest_ns is not None and remote_ns < self._latest_ns - REBOOT_NS
        set_back |= expected_ns is not None and expected_ns < receive_ns - REBOOT_NS
        if set_back and self._n >= PROOF_N:
            self.n_reboots += 1
        self._begin()

    def _count(self, remote_ns: int, receive_ns: int) -> None:
        if self._n == 0:
            self.n_segments += 1
            self._first_receive_ns = receive_ns
        elif self._await_ns and receive_ns - self._heard_ns > REBOOT_NS:
            self._await_ns = receive_ns + ANSWERS_NS  # after a silence they too begin anew
        self._n += 1
        self._heard_ns = receive_ns
        self._latest_ns = max(self._latest_ns or remote_ns, remote_ns)

    # -- where it stands -------------------------------------------------------------------------

    def _note_delay(self, remote_ns: int, receive_ns: int) -> bool:
        # without the drift within the short time, which would count as delay
        level_ns = round(receive_ns - remote_ns - self._slope * (remote_ns % BIN_NS))
        return _keep(self._delays, _Point(remote_ns, float(receive_ns - remote_ns), level_ns))

    def _follow(self, now_ns: int) -> None:
        """Lay new lines through what is known and make for the lower."""
        now_ns = max(now_ns, self._latest_ns or now_ns)
        for points in (self._answers, self._delays):
            while points and now_ns - points[0].remote_ns > FORGET_NS:
                points.popleft()
        line = self._line_of(self._delays, now_ns, np.full(len(self._delays), STAMP_S))
        # of the least delay itself nothing is seen; how far others exceed it hints at it
        excess_ns = float(np.median(self._excess_ns)) if self._excess_ns else 0.0
        systematic_ns = math.hypot(1e9 * STAMP_S, excess_ns)
        if self._answers:
            half_ns = np.array([each.cost_ns for each in self._answers])
            least_ns = float(half_ns.min())
            sigma_s = np.maximum(1e-9 * (half_ns - least_ns), MIN_SIGMA_S)
            exchanged = self._line_of(self._answers, now_ns, sigma_s)
            # causality: where the least delays are lower, the autopilot was slow to answer
            slow_ns = max(0.0, exchanged.offset_ns - line.offset_ns)
            systematic_ns = math.hypot(least_ns / math.sqrt(3), 0.5 * slow_ns)
            line = exchanged._replace(offset_ns=exchanged.offset_ns - slow_ns)
        self._fit_sigma_ns = math.hypot(line.sigma_ns, systematic_ns)
        self._make_for(now_ns, now_ns + round(line.offset_ns), line.slope)

    def _line_of(self, points: deque[_Point], now_ns: int, sigma_s: Array) -> _Line:
        base_ns = points[-1].offset_ns
        t_s = np.array([(each.remote_ns - now_ns) * 1e-9 for each in points])
        offset_s = np.array([(each.offset_ns - base_ns) * 1e-9 for each in points])
        value_s, slope, spread_s = _line_at_end(t_s, offset_s, sigma_s)
        return _Line(base_ns + 1e9 * value_s, slope, 1e9 * spread_s)

    def _make_for(self, remote_ns: int, host_ns: int, slope: float) -> None:
        standing_ns = self.host_ns(remote_ns)
        behind_ns = 0.0 if standing_ns is None else float(host_ns - standing_ns)
        if abs(behind_ns) > STEP_NS:
            behind_ns = 0.0
        self._line, self._slope = (remote_ns, host_ns), slope
        self._behind_ns = behind_ns
        self._slew_ns = max(SLEW_S * 1e9, abs(behind_ns) / MAX_SLEW)
        self.drift_ppm = -1e6 * slope / (1 + slope)
        self.sigma_ns = math.hypot(self._fit_sigma_ns, behind_ns)

    def _left_ns(self, passed_ns: int) -> float:
        """What is left of the correction that is under way."""
        return self._behind_ns * min(1.0, max(0.0, 1 - passed_ns / self._slew_ns))


def _keep(points: deque[_Point], point: _Point) -> bool:
    """Keep the best of each short time, in order of time; whether this one is."""
    number, newest = point.remote_ns // BIN_NS, points[-1] if points else None
    if newest is None or newest.remote_ns // BIN_NS < number:
        points.append(point)
        return True
    if newest.remote_ns // BIN_NS == number and point.cost_ns < newest.cost_ns:
        points[-1] = point
        return True
    return False


def _line_at_end(t_s: Array, value_s: Array, sigma_s: Array) -> tuple[float, float, float]:
    """Value at time 0, slope and standard deviation of that value, over the right length."""
    low, high = -math.inf, math.inf
    best: tuple[float, float, float] | None = None
    n_before = 0
    sigma_s = np.hypot(sigma_s, _scatter(t_s, value_s, sigma_s))
    for length_s in LENGTHS_S:
        inside = t_s >= -length_s
        n = int(np.count_nonzero(inside))
        if n == n_before:
            continue
        n_before = n
        found = _robust_line(t_s[inside], value_s[inside], sigma_s[inside])
        margin = CONFIDENCE * found[2]
        low, high = max(low, found[0] - margin), min(high, found[0] + margin)
        if low > high and best is not None:
            break
        best = found
    assert best is not None
    return best


def _scatter(t_s: Array, value_s: Array, sigma_s: Array) -> float:
    """What neighbours scatter beyond their sigmas; that a line is bent makes none of it."""
    if len(t_s) < 5:
        return 0.0
    share = (t_s[1:-1] - t_s[:-2]) / (t_s[2:] - t_s[:-2])
    bend = np.abs(value_s[1:-1] - (1 - share) * value_s[:-2] - share * value_s[2:])
    expected = sigma_s[1:-1] ** 2 + 0.25 * (sigma_s[:-2] ** 2 + sigma_s[2:] ** 2)
    for scatter_s in SCATTERS_S:
        if 1.4826 * float(np.median(bend / np.sqrt(expected + 1.5 * scatter_s**2))) <= 1:
            break
    return scatter_s


def _robust_line(t_s: Array, value_s: Array, sigma_s: Array) -> tuple[float, float, float]:
    weight = sigma_s**-2
    offset, slope, spread = 0.0, 0.0, 0.0
    for _ in range(3):
        # a line with a prior on its slope, solved about time 0
        total, first = float(weight.sum()), float(weight @ t_s)
        second = float(weight @ t_s**2) + PRIOR_DRIFT**-2
        right = float(weight @ value_s), float((weight * t_s) @ value_s)
        determinant = total * second - first**2
        offset = (second * right[0] - first * right[1]) / determinant
        slope = (total * right[1] - first * right[0]) / determinant
        residual = np.abs(value_s - offset - slope * t_s) / sigma_s
        spread = math.sqrt(second / determinant)
        weight = sigma_s**-2 / np.maximum(1.0, residual / HUBER)
    return offset, slope, spread
