"""Comparison of the IMU with the autopilot's own attitude: axes, delay and gravity.

Between attitudes the body has turned as the gyroscopes say, and over some seconds a vehicle does
not accelerate much on average, so that the specific force, turned into NED, is gravity. Each of the
48 ways in which axes can be interchanged and reversed, at each of several delays, is a hypothesis
with a chi-square by both.
"""

from __future__ import annotations

from collections import deque
from itertools import permutations, product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.estimation.inertial.acceleration_integral import GRAVITY_NED_M_S2
from companion.geometry.transforms import Array, rotation_from_quaternion, vectors_from_rotations
from companion.telemetry import AttitudeSample, ImuSample

WINDOW_S = 4.0
STEP_S, MAX_STEP_S = 0.04, 0.26
"""Between attitudes of which the turn is compared: that of 20 Hz, half lost, at most."""
LEAST_STEPS = 25
"""Turns that are compared, at least: a second of 25 Hz."""
SIGMA_RATE_RAD_S = 0.004
"""White noise of a mean rate over a step: gyroscopes' 0.005 deg/s per root of Hz, and rounding."""
MODEL_ERROR = 0.02
"""Share of a turn's square that stays unexplained in logs of real flights: scale, sampling."""
SIGMA_GYRO_BIAS_RAD_S = 0.03
"""Uncalibrated MEMS gyroscopes state 1 to 2 degrees per second."""
SIGMA_ACCELERATION_M_S2 = 2.5
"""Mean acceleration of a vehicle over the window: 10 m/s gained or lost."""
NARROW_S, WIDE_S, DELAY_STEP_S = 0.4, 1.6, 0.01
IDENTITY = 0


def _interchanged() -> Array:
    """All (48, 3, 3) ways to interchange and reverse axes; the first is the identity."""
    found = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        matrix = np.zeros((3, 3))
        matrix[range(3), order] = signs
        found.append(matrix)
    return np.stack(found)


BODY_FROM_IMU = _interchanged()


class Agreement(NamedTuple):
    """Fit of each hypothesis to the attitude.

    `chi_square` (48, D) is by way of `BODY_FROM_IMU` and by delay of the IMU's stamps, `delays_s`
    (D,). Shares of the body's turning are left `unexplained` by the best, and
    `identity_unexplained` by the IMU as it is at its best delay. `rate_rad_s` is the change of the
    body's rates, RMS. White noise of the attitudes counts for none of these three.
    """

    delays_s: Array
    chi_square: Array
    unexplained: float
    identity_unexplained: float
    rate_rad_s: float

    @property
    def best(self) -> tuple[int, float]:
        """Number of the likeliest way, and its delay."""
        way, delay = np.unravel_index(int(np.argmin(self.chi_square)), self.chi_square.shape)
        return int(way), float(self.delays_s[delay])


class ImuWindow(NamedTuple):
    """The last seconds as arrays; times in seconds from a common zero.

    IMU: `imu_s` (N,), `gyro_rad_s` and `accel_m_s2` (N, 3); attitudes: `attitude_s` (M,),
    `ned_from_body` (M, 3, 3).
    """

    imu_s: Array
    gyro_rad_s: Array
    accel_m_s2: Array
    attitude_s: Array
    ned_from_body: Array


class ImuRecord:
    """Collects samples of the last seconds."""

    def __init__(self) -> None:
        self._imu: deque[ImuSample] = deque()
        self._attitudes: deque[tuple[int, Array]] = deque()

    def take(self, sample: AttitudeSample | ImuSample) -> None:
        """Add a sample; one that is older than the last of its kind is left out."""
        kept_ns = round((WINDOW_S + WIDE_S + NARROW_S) * 1e9)
        if isinstance(sample, ImuSample):
            if not self._imu or sample.t_ns > self._imu[-1].t_ns:
                self._imu.append(sample)
            while self._imu[0].t_ns < self._imu[-1].t_ns - kept_ns:
                self._imu.popleft()
            return
        step_ns = round((STEP_S - 1e-3) * 1e9)
        if not self._attitudes or sample.t_ns >= self._attitudes[-1][0] + step_ns:
            rotation = rotation_from_quaternion(sample.ned_from_body)
            self._attitudes.append((sample.t_ns, rotation))
        while self._attitudes[0][0] < self._attitudes[-1][0] - kept_ns:
            self._attitudes.popleft()

    def forget(self) -> None:
        """Begin anew with what comes next."""
        self._imu.clear()

    def window(self) -> ImuWindow | None:
        """The last seconds; None without samples of both kinds."""
        if len(self._imu) < 2 or len(self._attitudes) < 2:
            return None
        zero_ns = self._attitudes[0][0]
        return ImuWindow(
            np.array([each.t_ns - zero_ns for each in self._imu]) * 1e-9,
            np.stack([each.gyro_rad_s for each in self._imu]),
            np.stack([each.accel_m_s2 for each in self._imu]),
            np.array([t_ns - zero_ns for t_ns, _ in self._attitudes]) * 1e-9,
            np.stack([rotation for _, rotation in self._attitudes]),
        )


def force_by_way(window: ImuWindow) -> Array:
    """Mean acceleration (48, 3) in NED, m/s2, that each way of its axes gives."""
    since_s = window.imu_s[-1] - WINDOW_S
    use = (window.imu_s >= max(since_s, window.attitude_s[0])) & (
        window.imu_s <= window.attitude_s[-1] + STEP_S
    )
    if not use.any():
        return np.zeros((len(BODY_FROM_IMU), 3))
    nearest = _nearest(window.attitude_s, window.imu_s[use])
    rotations, forces = window.ned_from_body[nearest], window.accel_m_s2[use]
    products = np.einsum("nab,nc->abc", rotations, forces) / len(forces)
    out: Array = np.einsum("abc,hbc->ha", products, BODY_FROM_IMU) + GRAVITY_NED_M_S2
    return out


def agreement(
    window: ImuWindow, latest_s: float, without_heading: bool = False
) -> Agreement | None:
    """Comparison with delays up to `latest_s`; None with too little data.

    `without_heading` leaves out turns about the vertical, for the IMU's axes as they are:
    autopilots align their heading anew in flight.
    """
    delays_s = np.arange(-NARROW_S, latest_s + 0.5 * DELAY_STEP_S, DELAY_STEP_S)
    end_s = window.imu_s[-1] - latest_s
    begin_s = max(window.imu_s[0] + NARROW_S, end_s - WINDOW_S)
    inside = (window.attitude_s >= begin_s) & (window.attitude_s <= end_s)
    t_s, rotations = window.attitude_s[inside], window.ned_from_body[inside]
    if len(t_s) <= LEAST_STEPS:
        return None
    dt_s = np.diff(t_s)
    use = dt_s <= MAX_STEP_S
    n = int(use.sum())
    if n < LEAST_STEPS:
        return None
    turns = vectors_from_rotations(np.matmul(rotations[:-1].transpose(0, 2, 1), rotations[1:]))
    seen = (turns / dt_s[:, None])[use]
    gyro = (np.diff(_turned(window, t_s[None] + delays_s[:, None]), axis=1) / dt_s[:, None])[:, use]
    if without_heading:
        down = rotations[:-1][use, 2]
        seen = seen - np.einsum("na,na->n", seen, down)[:, None] * down
        gyro = gyro - np.einsum("dna,na->dn", gyro, down)[..., None] * down
    seen_mean, gyro_mean = seen.mean(0), gyro.mean(1)
    seen, gyro = seen - seen_mean, gyro - gyro_mean[:, None]
    total, squared = float((seen**2).sum()), _squares(seen, gyro)
    way, delay = np.unravel_index(int(np.argmin(squared)), squared.shape)
    left, in_row = seen - gyro[delay] @ BODY_FROM_IMU[way].T, np.diff(np.flatnonzero(use)) == 1
    noise = _white(left, in_row)
    turning = max(total - noise, 1e-12)
    variance = max(
        (float(squared.min()) - noise) / (3 * n), SIGMA_RATE_RAD_S**2,
        MODEL_ERROR * turning / (3 * n),
    )  # fmt: skip
    whitened = squared / variance
    if noise > 0.0:
        covariance = (variance + noise / (3 * n)) * np.eye(n)
        after = np.flatnonzero(in_row)
        covariance[after, after + 1] = covariance[after + 1, after] = -noise / (6 * n)
        by = np.linalg.inv(np.linalg.cholesky(covariance))
        whitened = _squares(by @ seen, _each(by, gyro))
        whitened /= max(float(whitened.min()) / (3 * n), 1.0)
    off = seen_mean - np.einsum("hab,db->hda", BODY_FROM_IMU, gyro_mean)
    chi_square = whitened + (off**2).sum(2) / SIGMA_GYRO_BIAS_RAD_S**2
    gained = (force_by_way(window) ** 2).sum(1) / SIGMA_ACCELERATION_M_S2**2
    share = np.maximum(squared - noise, 0.0) / turning
    best = np.unravel_index(int(np.argmin(chi_square + gained[:, None])), squared.shape)
    return Agreement(
        delays_s, chi_square + gained[:, None], float(share[best]), float(share[IDENTITY].min()),
        float(np.sqrt(turning / n)),
    )  # fmt: skip


def _squares(seen: Array, gyro: Array) -> Array:
    """|seen - H gyro|2 (48, D) for all ways H and delays at once, of (N, 3) and (D, N, 3)."""
    common = _each(seen.T, gyro)
    both = float((seen**2).sum()) + (gyro**2).sum((1, 2))
    out: Array = np.maximum(both - 2.0 * np.einsum("hab,dab->hd", BODY_FROM_IMU, common), 0.0)
    return out


def _each(by: Array, of: Array) -> Array:
    """Products (D, M, 3) of a matrix (M, N) and each of (D, N, 3), as one of large matrices."""
    delays, n, axes = of.shape
    out = by @ of.transpose(1, 0, 2).reshape(n, delays * axes)
    return out.reshape(len(by), delays, axes).transpose(1, 0, 2)


def _white(left: Array, in_row: NDArray[np.bool_]) -> float:
    """Squares in rates (N, 3) between attitudes that come of white noise of these.

    What one attitude is off by is in the turn before it and, with the other sign, in the one after.
    Other axes, or another time, leave what goes on from one turn to the next: none of this.
    `in_row` (N - 1,) is true of turns that follow each other.
    """
    if not in_row.any():
        return 0.0
    common = float((left[:-1][in_row] * left[1:][in_row]).sum()) / np.count_nonzero(in_row)
    return float(np.clip(-2.0 * common * len(left), 0.0, (left**2).sum()))


def _turned(window: ImuWindow, at_s: Array) -> Array:
    """Integral of the gyroscopes' rates (..., 3), rad, at times (...)."""
    rates, t_s = window.gyro_rad_s, window.imu_s
    steps = 0.5 * (rates[1:] + rates[:-1]) * np.diff(t_s)[:, None]
    turned = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return np.stack([np.interp(at_s, t_s, turned[:, axis]) for axis in range(3)], -1)


def _nearest(times: Array, at: Array) -> NDArray[np.intp]:
    i = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
    return i - (at - times[i - 1] < times[i] - at)
