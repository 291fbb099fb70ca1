"""Verdict on the IMU by the autopilot's own attitude: whether a scale may come of it.

It is reached before any scale is given out, and can be revised. A turned or late IMU is said, not
corrected: what it measured is not used.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from companion.estimation.inertial.imu_comparison import (
    BODY_FROM_IMU,
    IDENTITY,
    NARROW_S,
    WIDE_S,
    WINDOW_S,
    Agreement,
    ImuRecord,
    ImuWindow,
    agreement,
    force_by_way,
)
from companion.estimation.inertial.imu_faults import AXES, fault
from companion.geometry.transforms import Array, vector_from_rotation
from companion.messages import Warned
from companion.telemetry import AttitudeSample, ImuSample

CHECK_NS, CHECK_OLD_NS = 500_000_000, 1_000_000_000
"""Period of checks until axes and stamps are confirmed, and later."""
N_AGREEING = 2
"""Successive checks with the same fault that are required."""
N_UNEXPLAINED = 12
"""The same where nothing explains the rates: a jump of the attitude's tilt looks so for 4 s."""
MAX_SILENT_S = 1.0
MAX_DELAY_S = 0.055
"""Of the stamps; logs of real autopilots show 0 to 0.03 s."""
SURE = 30.0
"""Chi-square by which an explanation must be better; in logs of flights a wrong one was better by 8
at most, after a crash. Of a vehicle that stands, 48 ways at 81 delays are only noise: the best of
them is better by 10 at every other check, and by 25 in one of a hundred."""
EXPLAINED, UNEXPLAINED = 0.5, 0.7
"""Shares of the body's turning that are left by what explains it, and by what does not."""
WHOLLY = 0.1
"""Part of what the axes as they are leave that others leave where they are the reason: a fiftieth.
Where they fit a heading that swings by chance it is a sixth."""
EXCITED_RAD_S = 0.05
"""Change of rates with which a comparison must succeed."""
QUIET_CHECKS = 16
"""Checks after which a body that does not turn has shown as much as it can: of ten seconds."""
MAX_VERTICAL_M_S2, MAX_HORIZONTAL_M_S2 = 3.0, 8.0
"""Mean acceleration over the window: 12 m/s of climb gained, and a circle at 39 degrees of bank."""
RETRY_NS, MAX_RETRY_NS = 5_000_000_000, 160_000_000_000
"""Time without a fault before the IMU is used again; doubled each time."""
ALWAYS_NS = -(2**62)

NOT_USED = "the autopilot's IMU is not used: no scale and no dead reckoning by it"
USED_AGAIN = "the autopilot's IMU is used again"
SILENT, DELAY, RATES, AXES_TURNED = "silent", "delay", "rates", "axes"
FORWARD_LEFT_UP = "its axes are forward, left and up, not forward, right and down"


class Change(NamedTuple):
    """A change of the verdict; samples since `invalid_since_ns` were not to be used."""

    warning: Warned
    invalid_since_ns: int | None = None


class _Fault(NamedTuple):
    """A fault: `kind`, by which it is counted, words, and whether axes or stamps are in doubt."""

    kind: str
    words: str
    doubted: bool = False
    needed: int = N_AGREEING


class ImuVerdict:
    """Judges samples as they come, once or twice a second."""

    def __init__(self) -> None:
        self.fault = ""
        """Reason for not using the IMU, in words; empty while it is used."""
        self.confirmed = False
        """True once the body's turns have shown that axes and stamps are right."""
        self._record = ImuRecord()
        self._due_ns: int | None = None
        self._ways = np.zeros(len(BODY_FROM_IMU), bool)
        """Other axes that were excluded."""
        self._in_time = False
        self._kind, self._n_same, self._n_compared = "", 0, 0
        self._excited, self._stood, self._agrees = False, False, True
        """Turned enough to compare; did not for long; no other axes, no delay are better."""
        self._since_good_ns: int | None = None
        self._retry_ns = RETRY_NS

    @property
    def believed(self) -> bool:
        """True if scale and dead reckoning may go by the samples so far."""
        return not self.fault and self._shown

    @property
    def _shown(self) -> bool:
        """True once axes and stamps were compared, or nothing can be seen of them.

        A vehicle that stood until now and lifts off has turned too little yet to exclude others:
        then it is enough that none is better.
        """
        return self.confirmed or (self._stood and self._agrees)

    def take(self, sample: AttitudeSample | ImuSample) -> Change | None:
        """Add a sample; a change of the verdict, if there is one."""
        self._record.take(sample)
        if isinstance(sample, ImuSample):
            return None
        if self._due_ns is None:
            self._due_ns = sample.t_ns + CHECK_NS
        if sample.t_ns < self._due_ns:
            return None
        old = self.confirmed and not self._kind and not self.fault
        self._due_ns = sample.t_ns + (CHECK_OLD_NS if old else CHECK_NS)
        window = self._record.window()
        return None if window is None else self._check(sample.t_ns, window)

    def _check(self, t_ns: int, window: ImuWindow) -> Change | None:
        found, compared = self._found(window)
        if found is not None:
            self._since_good_ns, self._agrees = None, False
            self._n_same = self._n_same + 1 if found.kind == self._kind else 1
            self._kind = found.kind
            if self.fault or self._n_same < found.needed:
                return None
            return self._refuse(t_ns, found)
        self._kind, self._n_same = "", 0
        if compared is None:
            return None
        self._confirm(compared)
        if not self.fault:
            return None
        since_ns = self._since_good_ns = self._since_good_ns or t_ns
        if t_ns - since_ns < self._retry_ns or not self._shown:
            return None
        self._retry_ns = min(2 * self._retry_ns, MAX_RETRY_NS)
        was, self.fault = self.fault, ""
        return Change(Warned(t_ns, USED_AGAIN, f"before, {was}", good=True))

    def _refuse(self, t_ns: int, found: _Fault) -> Change:
        seen_ns = round((WINDOW_S + WIDE_S + NARROW_S) * 1e9)
        seen_ns += CHECK_OLD_NS + found.needed * CHECK_NS
        since_ns: int | None = t_ns - seen_ns if self.confirmed else ALWAYS_NS
        if found.kind == SILENT:
            self._record.forget()
            since_ns = None if self._shown else ALWAYS_NS
        if found.doubted:
            self._ways[:], self._in_time, self.confirmed = False, False, False
            self._excited, self._stood, self._n_compared = False, False, 0
        self.fault = found.words
        return Change(Warned(t_ns, NOT_USED, found.words), since_ns)

    def _found(self, window: ImuWindow) -> tuple[_Fault | None, Agreement | None]:
        """A fault, and the comparison with the attitude."""
        if window.attitude_s[-1] - window.imu_s[-1] > MAX_SILENT_S:
            alone_s = window.attitude_s[-1] - max(window.imu_s[-1], _heard_since_s(window))
            is_silent = alone_s > MAX_SILENT_S
            return _Fault(SILENT, "it is silent", needed=1) if is_silent else None, None
        own = fault(window)
        if own is not None:
            return _Fault(own.split(":")[0], own), None
        compared = agreement(window, NARROW_S)
        if compared is None:
            return None, None
        excited = compared.rate_rad_s > EXCITED_RAD_S
        explained = compared.unexplained <= EXPLAINED
        found = None
        if (excited or explained) and not (explained and compared.best[0] == IDENTITY):
            # other axes may only look so where the IMU is later than was looked for
            wide = agreement(window, WIDE_S)
            if wide is None:
                return None, None
            compared, found = wide, _turned_or_late(wide)
        else:
            found = _turned_or_late(compared)
        if found is None and excited and compared.identity_unexplained > UNEXPLAINED:
            words = "its rates of turn are not those of the attitude"
            found = _Fault(RATES, words, True, N_UNEXPLAINED)
        wholly = compared.unexplained < WHOLLY * compared.identity_unexplained
        if found is not None and not (found.kind == AXES_TURNED and wholly):
            found = found if _seen_in_tilt(found.kind, window) else None
        return found or _gravity(force_by_way(window)), compared

    def _confirm(self, compared: Agreement) -> None:
        """Exclude other axes and delays."""
        self._excited |= compared.rate_rad_s > EXCITED_RAD_S
        self._n_compared += 1
        self._stood |= self._n_compared >= QUIET_CHECKS and not self._excited
        in_time = np.abs(compared.delays_s) <= MAX_DELAY_S
        best = float(compared.chi_square[IDENTITY, in_time].min())
        worse = best - float(compared.chi_square.min())
        self._agrees = worse < SURE
        if compared.identity_unexplained < EXPLAINED:
            self._ways |= compared.chi_square.min(axis=1) > best + SURE
            self._in_time |= bool(compared.chi_square[IDENTITY, ~in_time].min() > best + SURE)
        self.confirmed = self._in_time and bool(self._ways[1:].all())


def _heard_since_s(window: ImuWindow) -> float:
    """Since when attitudes have come without a pause: a cut link silences all that it carries."""
    pauses = np.flatnonzero(np.diff(window.attitude_s) > MAX_SILENT_S)
    return float(window.attitude_s[pauses[-1] + 1] if len(pauses) else window.attitude_s[0])


def _turned_or_late(compared: Agreement) -> _Fault | None:
    way, delay_s = compared.best
    if compared.unexplained > EXPLAINED:
        return None
    chi_square = compared.chi_square
    least = float(chi_square.min())
    if way != IDENTITY:
        rest = np.delete(chi_square, way, axis=0)
        if rest.min() > least + SURE:
            return _Fault(AXES_TURNED, f"{turned_in_words(BODY_FROM_IMU[way])}", True)
        if chi_square[IDENTITY].min() > least + SURE:
            return _Fault(AXES_TURNED, "its axes are not those of the body", True)
        return None
    in_time = np.abs(compared.delays_s) <= MAX_DELAY_S
    if chi_square[IDENTITY, in_time].min() > least + SURE:
        side = "late" if delay_s > 0.0 else "early"
        return _Fault(DELAY, f"it is {abs(delay_s) * 1e3:.0f} ms {side}", True)
    return None


def _seen_in_tilt(kind: str, window: ImuWindow) -> bool:
    """True if turns about level axes show a fault, too.

    ArduPilot aligns its heading anew as it climbs, by some degrees within a second or two: about
    the vertical that looks like gyroscopes that are early or late. PX4's heading swings for seconds
    on the ground and after a take-off: like gyroscopes with other axes, or that turn otherwise.
    """
    compared = agreement(window, WIDE_S, without_heading=True)
    if compared is None:
        return False
    if kind != DELAY:
        unexplained = compared.identity_unexplained > EXPLAINED
        return unexplained and compared.rate_rad_s > EXCITED_RAD_S
    chi_square = compared.chi_square[IDENTITY]
    in_time = np.abs(compared.delays_s) <= MAX_DELAY_S
    return bool(chi_square[in_time].min() > chi_square.min() + SURE)


def _gravity(accelerations: Array) -> _Fault | None:
    """A mean acceleration that no vehicle has, by the axes as they are: (48, 3), m/s2, NED."""
    found = accelerations[IDENTITY]
    if abs(found[2]) < MAX_VERTICAL_M_S2 and float(np.hypot(*found[:2])) < MAX_HORIZONTAL_M_S2:
        return None
    mean = " ".join(f"{each:+.1f}" for each in found)
    words = f"its accelerations do not agree with gravity: on average {mean} m/s2 are left"
    other = np.linalg.norm(accelerations, axis=1)
    if other.min() < MAX_VERTICAL_M_S2:
        words = f"its axes are not those of the body: on average {mean} m/s2 are left of gravity"
    return _Fault("gravity", words, True)


def turned_in_words(body_from_imu: Array) -> str:
    """Lie of the axes of an IMU in the body, in words."""
    if np.linalg.det(body_from_imu) < 0.0:
        if np.array_equal(np.abs(body_from_imu), np.eye(3)):
            flipped = [AXES[i] for i in range(3) if body_from_imu[i, i] < 0.0]
            return f"its {', '.join(flipped)} axis points the other way"
        return "its axes are not the body's, and left-handed"
    turn = vector_from_rotation(body_from_imu)
    degrees = float(np.degrees(np.linalg.norm(turn)))
    about = turn / max(float(np.abs(turn).max()), 1e-9)
    if np.array_equal(body_from_imu, np.diag([1.0, -1.0, -1.0])):
        return FORWARD_LEFT_UP
    single = [i for i in range(3) if abs(about[i]) > 0.5]
    if len(single) == 1:
        named = f"{'-' if about[single[0]] < 0.0 else ''}{AXES[single[0]]}"
    else:
        named = "(" + ", ".join(f"{each:.0f}" for each in about) + ")"
    return f"its axes are not the body's: turned by {degrees:.0f} degrees about {named}"
