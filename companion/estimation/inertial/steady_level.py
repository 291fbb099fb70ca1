"""Attitude whose level is by the gyroscopes less their bias, and whose heading is the autopilot's.

An autopilot finds a change of the bias by where its own place goes astray, which takes it minutes:
meanwhile its level drifts, and any place that accelerometers give with it. The bias shows sooner in
the rotations of the images.

Samples from which the autopilot has taken the biases of its own EKF fit its own level alone: where
it learns better, both change together, by as much as a tenth of a m/s2 and by as much of gravity.
There the level is the autopilot's, unless the images show a bias of roll and pitch in them that an
EKF would have found: then they count as measured.
"""

from __future__ import annotations

import numpy as np

from companion.estimation.inertial.turn_integral import TurnIntegral, regular_s
from companion.geometry.geodesy import STANDARD_GRAVITY_M_S2
from companion.geometry.transforms import (
    Array,
    nearest_rotation,
    rotation_from_vector,
    vector_from_rotation,
)
from companion.slam.compiled.inertial_steps import led_level

SIGMA_AUTOPILOT_RAD, AUTOPILOT_S = float(np.radians(0.15)), 20.0
"""Of the autopilot's level, and for how long it is off by the same."""
SIGMA_IMAGES_RAD, IMAGES_S = 1e-3, 5.0
"""Of the rotation of images in their map, which bends by as much as what they see is renewed."""
SIGMA_BIAS_RAD_S, BIAS_WALK_RAD_S2 = 0.01, 4e-5
"""From one power-on to the next; then by warming, per root of a second: a fiftieth of a degree per
second in a minute."""
LEAST_DENSITY_RAD_S = 1e-4
"""White noise of a good MEMS gyroscope, per root of Hz."""
TURN_RATIO = 0.003
"""Error of a turn by the gyroscopes' own scale."""
HEADING_RATIO = 100.0
"""Error of an autopilot's heading by that of its level: it swings while it is aligned."""
REFUSED_SIGMAS = 5.0
"""Of a rotation that goes on: the map has been corrected, or the autopilot's heading."""
DOUBTED_RAD_S = 0.002
"""Of the bias, at most, after each refusal: what is wrong may be the bias, again and again."""
SIGMA_DELAY_S = 0.02
"""Of the stamps, while the clock of the link is corrected: a body that turns seems to jump."""
MAX_BETWEEN_S = 0.5
MAX_APART_RAD = float(np.radians(3.0))
"""From the autopilot's level: three standard deviations of one that goes by dead reckoning."""
IMAGES_LAST_S = 15.0
"""Without images for longer, the bias is learnt from the autopilot's attitude, as before them."""
AS_MEASURED_RAD_S, AS_MEASURED_SIGMAS = 2e-3, 5.0
"""Bias of roll and pitch from which on marked samples count as measured. It turns the level by a
degree in nine seconds, by which an EKF finds it."""
BY_AUTOPILOT = -1
WALK_M_S2, AUTOPILOT_WALK_M_S2 = 0.003, 0.03
"""Walk of the horizontal acceleration by a level, per root of a second: by gyroscopes, as their
samples come, and by an autopilot's after each manoeuvre."""
LED_HZ = 0.3
"""A gain that passes half of these on: manoeuvres last for seconds."""


class SteadyLevel:
    """Integrates rates without the bias that rotations show.

    It is led to the autopilot's level as fast as noise and the uncertainty of the bias ask: where
    nothing is known of the bias yet, in a fraction of a second.
    """

    def __init__(self, turns: TurnIntegral) -> None:
        self._turns = turns
        self._last: tuple[int, Array] | None = None
        """Time and rates of the last sample."""
        self._rotation = np.eye(3)
        self._apart_rad = 0.0
        self._is_autopilots = self._shows_bias = False
        self._bias = np.zeros(3)
        self._covariance = np.diag(np.r_[np.zeros(3), np.full(3, SIGMA_BIAS_RAD_S**2)])
        """Of the rotation that is expected of the next image, and of the bias."""
        self._expected, self._turned = np.eye(3), np.eye(3)
        self._source, self._gap = BY_AUTOPILOT, -1
        self._begun_ns = self._seen_ns = -(2**62)
        self._images_ns = -(2**62)

    @property
    def bias_rad_s(self) -> Array:
        """Bias (3,) of the gyroscopes, body axes."""
        return self._bias

    @property
    def contradicted(self) -> bool:
        """True where it and the autopilot's level exclude each other: either may be wrong."""
        return self._apart_rad > MAX_APART_RAD

    @property
    def _sigma_bias(self) -> float:
        """Of the bias of roll and pitch, the larger."""
        return float(np.sqrt(max(self._covariance[3, 3], self._covariance[4, 4])))

    @property
    def _noise(self) -> float:
        return max(self._turns.density_rad_s, LEAST_DENSITY_RAD_S) ** 2

    @property
    def lead_hz(self) -> float:
        """Gain by which the level is led to the autopilot's.

        That is by the same gyroscopes: it is off by the same for no longer than their noise lets
        it, and it was integrated from samples of which some do not come.
        """
        same_s = min(AUTOPILOT_S, SIGMA_AUTOPILOT_RAD**2 / self._noise)
        wanders = float(np.sqrt(self._noise / (2.0 * same_s)))
        return (wanders + self._sigma_bias) / SIGMA_AUTOPILOT_RAD

    @property
    def walk_m_s2(self) -> float:
        """Walk of the horizontal acceleration by an error of the level, per root of a second."""
        led = self.lead_hz**2
        share = 1.0 if self._is_autopilots else led / (LED_HZ**2 + led)
        by_noise = STANDARD_GRAVITY_M_S2 * float(np.sqrt(self._noise))
        return float(np.linalg.norm([WALK_M_S2, by_noise, share * AUTOPILOT_WALK_M_S2]))

    def turn(self, from_ns: int, to_ns: int) -> tuple[Array, float] | None:
        """Rotation (3, 3) of the body at a time in its axes at another; its standard deviation.

        By the gyroscopes less their bias; None where samples are missing.
        """
        (first, last), _, gaps = self._turns.at(np.array([from_ns, to_ns]))
        if gaps[0] < 0 or gaps[0] != gaps[1]:
            return None
        dt_s = (to_ns - from_ns) * 1e-9
        turn = first.T @ last @ rotation_from_vector(-dt_s * self._bias)
        by_scale = TURN_RATIO * float(np.linalg.norm(vector_from_rotation(turn)))
        by_bias = dt_s * float(np.sqrt(np.trace(self._covariance[3:, 3:]) / 3.0))
        by_noise = float(np.sqrt(self._noise * dt_s))
        return turn, float(np.linalg.norm([by_scale, by_bias, by_noise]))

    def reset(self) -> None:
        """Begin anew with the next sample, from the autopilot's attitude."""
        self._last = None

    def of(self, t_ns: int, rates: Array, autopilot: Array, less_biases: bool = False) -> Array:
        """`ned_from_body` (3, 3) of a sample, in order of time; `autopilot` is its own there.

        With `less_biases` the sample is less what the autopilot's EKF takes for biases.
        """
        last, self._last = self._last, (t_ns, rates)
        self._is_autopilots = less_biases and not self._shows_bias
        if last is None:
            self._rotation, self._apart_rad = autopilot, 0.0
            return autopilot
        dt_s = regular_s((t_ns - last[0]) * 1e-9, self._turns.interval_s)
        gain = 1.0 if self._is_autopilots else min(self.lead_hz * dt_s, 1.0)
        self._rotation, self._apart_rad = led_level(
            self._rotation, autopilot, last[1], rates, self._bias, dt_s, gain
        )
        if t_ns - self._images_ns > IMAGES_LAST_S * 1e9 and t_ns - self._seen_ns > 1e8:
            self._learn(t_ns, autopilot, BY_AUTOPILOT, SIGMA_AUTOPILOT_RAD, AUTOPILOT_S)
        return self._rotation

    def see(self, t_ns: int, segment: int, map_from_body: Array) -> None:
        """Learn of the bias from the rotation (3, 3) of an image in its map."""
        self._images_ns = t_ns
        self._learn(t_ns, map_from_body, segment, SIGMA_IMAGES_RAD, IMAGES_S)
        found = float(np.hypot(self._bias[0], self._bias[1]))
        if self._shows_bias:  # half of it is enough, lest it come and go
            self._shows_bias = found > 0.5 * AS_MEASURED_RAD_S
        else:
            least = max(AS_MEASURED_RAD_S, AS_MEASURED_SIGMAS * self._sigma_bias)
            self._shows_bias = found > least

    def _learn(self, t_ns: int, seen: Array, source: int, sigma_rad: float, same_s: float) -> None:
        """Kalman filter of the rotation of a source, in its axes, and the bias."""
        turned, rates, gaps = (each[0] for each in self._turns.at(np.array([t_ns])))
        dt_s = (t_ns - self._seen_ns) * 1e-9
        if gaps < 0 or dt_s <= 0.0:
            return
        goes_on = source == self._source and gaps == self._gap and dt_s < MAX_BETWEEN_S
        self._covariance[3:, 3:] += BIAS_WALK_RAD_S2**2 * min(dt_s, 60.0) * np.eye(3)
        if goes_on:
            late_rad = SIGMA_DELAY_S * float(np.linalg.norm(rates))
            sigma_rad = float(np.hypot(sigma_rad, late_rad))
            goes_on = self._corrected(t_ns, seen, turned, dt_s, sigma_rad, same_s)
        if not goes_on:
            self._expected, self._begun_ns = seen, t_ns
            self._covariance[:3] = self._covariance[:, :3] = 0.0
            self._covariance[:3, :3] = sigma_rad**2 * np.eye(3)
        self._source, self._seen_ns, self._gap, self._turned = source, t_ns, int(gaps), turned

    def _corrected(
        self, t_ns: int, seen: Array, turned: Array, dt_s: float, sigma_rad: float, same_s: float
    ) -> bool:
        """Go on by gyroscopes to a rotation and correct by it; False where that jumps."""
        turn = self._turned.T @ turned
        by_turn = TURN_RATIO * float(np.linalg.norm(vector_from_rotation(turn)))
        step = np.eye(6)
        step[:3, 3:] = -dt_s * self._expected
        expected = self._expected @ turn @ rotation_from_vector(-dt_s * self._bias)
        covariance = step @ self._covariance @ step.T
        covariance[:3, :3] += (self._noise * dt_s + by_turn**2) * np.eye(3)
        innovation = vector_from_rotation(seen @ expected.T)
        variance = float(np.trace(covariance[:3, :3])) / 3.0 + sigma_rad**2
        squared = float(innovation @ innovation)
        if squared > REFUSED_SIGMAS**2 * variance:
            # or the bias is what is wrong
            since_s = (t_ns - self._begun_ns) * 1e-9
            self._covariance[3:, 3:] += min(squared / since_s**2, DOUBTED_RAD_S**2) * np.eye(3)
            return False
        one = max(2.0 * same_s / dt_s, 1.0) * sigma_rad**2 * np.eye(3)
        if self._source == BY_AUTOPILOT:
            one[2, 2] *= HEADING_RATIO**2
        gain = np.linalg.solve(covariance[:3, :3] + one, covariance[:3]).T
        correction = gain @ innovation
        self._expected = nearest_rotation(rotation_from_vector(correction[:3]) @ expected)
        self._bias = self._bias + correction[3:]
        covariance = covariance - gain @ covariance[:3]
        self._covariance = 0.5 * (covariance + covariance.T)
        return True
