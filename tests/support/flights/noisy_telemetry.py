"""Telemetry of a flight as worse sensors would have measured it: the same, with noise of a seed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from companion.geometry.transforms import Array
from companion.telemetry import AttitudeSample, ImuSample, Telemetry

SIGMA_ACCEL_M_S2, SIGMA_GYRO_RAD_S = 0.08, 0.004
"""White, at each sample; a small autopilot's in the vibration of its frame, at 100 Hz."""
BIAS_ACCEL_M_S2, BIAS_GYRO_RAD_S = 0.06, 0.004
"""Of the bias of a flight, along each axis."""
SIGMA_SENSITIVITY = 0.01
"""Of each accelerometer's own scale: datasheets state 0.5 to 1 %."""
SIGMA_ATTITUDE_RAD = np.radians(0.1)
"""White, about each axis."""
SIGMA_TILT_RAD, TILT_TAU_S = np.radians(0.2), 20.0
"""About each level axis, as an autopilot's is off otherwise after each manoeuvre."""


def with_noise(samples: Iterable[Telemetry], seed: int) -> Iterator[Telemetry]:
    """The same samples with noise on attitudes, rates and accelerations; seed 0 leaves them."""
    if not seed:
        yield from samples
        return
    rng = np.random.default_rng(seed)
    bias_accel = rng.normal(scale=BIAS_ACCEL_M_S2, size=3)
    bias_gyro = rng.normal(scale=BIAS_GYRO_RAD_S, size=3)
    sensitivity = 1.0 + np.random.default_rng([seed, 1]).normal(scale=SIGMA_SENSITIVITY, size=3)
    tilt, tilt_ns = rng.normal(scale=SIGMA_TILT_RAD, size=2), None
    for sample in samples:
        if isinstance(sample, ImuSample):
            yield replace(
                sample,
                accel_m_s2=sensitivity * sample.accel_m_s2
                + bias_accel
                + rng.normal(0, SIGMA_ACCEL_M_S2, 3),
                gyro_rad_s=sample.gyro_rad_s + bias_gyro + rng.normal(0, SIGMA_GYRO_RAD_S, 3),
            )
        elif isinstance(sample, AttitudeSample):
            kept = 0.0 if tilt_ns is None else np.exp((tilt_ns - sample.t_ns) * 1e-9 / TILT_TAU_S)
            tilt = kept * tilt + np.sqrt(1 - kept**2) * rng.normal(scale=SIGMA_TILT_RAD, size=2)
            tilt_ns = sample.t_ns
            white = rng.normal(scale=SIGMA_ATTITUDE_RAD, size=3)
            yield replace(sample, ned_from_body=_turned(sample.ned_from_body, tilt, white))
        else:
            yield sample


def _turned(ned_from_body: Array, tilt_rad: Array, white_rad: Array) -> Array:
    """A quaternion wxyz after a turn (2,) about the level axes and one (3,) about the body's."""
    given = Rotation.from_quat(np.roll(ned_from_body, -1))
    turned = Rotation.from_rotvec([*tilt_rad, 0.0]) * given * Rotation.from_rotvec(white_rad)
    return np.asarray(np.roll(turned.as_quat(), 1))
