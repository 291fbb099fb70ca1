"""Inertial kernels: what each sample of the IMU takes a few small products for."""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Array
from companion.slam.compiled.compiling import compiled, number, numbers, pairs, pairs_out, part


@part
def _product(a: Array, b: Array) -> Array:
    """Product of two rotations (3, 3)."""
    out = np.empty((3, 3))
    for i in range(3):
        for k in range(3):
            out[i, k] = a[i, 0] * b[0, k] + a[i, 1] * b[1, k] + a[i, 2] * b[2, k]
    return out


@part
def _rotation(x: float, y: float, z: float) -> Array:
    """Rotation (3, 3) of a rotation vector (Rodrigues)."""
    theta2 = x * x + y * y + z * z
    theta = np.sqrt(theta2)
    if theta < 1e-8:
        first, second = 1.0, 0.5
    else:
        first, second = np.sin(theta) / theta, (1.0 - np.cos(theta)) / theta2
    out = np.empty((3, 3))
    out[0, 0] = 1.0 - second * (y * y + z * z)
    out[1, 1] = 1.0 - second * (x * x + z * z)
    out[2, 2] = 1.0 - second * (x * x + y * y)
    out[0, 1], out[1, 0] = second * x * y - first * z, second * x * y + first * z
    out[0, 2], out[2, 0] = second * x * z + first * y, second * x * z - first * y
    out[1, 2], out[2, 1] = second * y * z - first * x, second * y * z + first * x
    return out


@part
def _vector(r: Array) -> tuple[float, float, float]:
    """Rotation vector of a rotation (3, 3) by less than half a turn (Shepperd's method)."""
    t = r[0, 0] + r[1, 1] + r[2, 2]
    largest = max(max(t, r[0, 0]), max(r[1, 1], r[2, 2]))
    if t == largest:
        w, x, y, z = 1 + t, r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    elif r[0, 0] == largest:
        w, x = r[2, 1] - r[1, 2], 1 + 2 * r[0, 0] - t
        y, z = r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]
    elif r[1, 1] == largest:
        w, x = r[0, 2] - r[2, 0], r[0, 1] + r[1, 0]
        y, z = 1 + 2 * r[1, 1] - t, r[1, 2] + r[2, 1]
    else:
        w, x = r[1, 0] - r[0, 1], r[0, 2] + r[2, 0]
        y, z = r[1, 2] + r[2, 1], 1 + 2 * r[2, 2] - t
    size = np.sqrt(w * w + x * x + y * y + z * z)
    size = -size if w < 0.0 else size
    w, x, y, z = w / size, x / size, y / size, z / size
    sine = np.sqrt(x * x + y * y + z * z)
    ratio = 2.0 if sine < 1e-12 else 2.0 * np.arctan2(sine, w) / sine
    return ratio * x, ratio * y, ratio * z


@compiled(numbers, numbers, number)
def rotation_between(first: Array, second: Array, share: float) -> Array:
    """Rotation (3, 3) of a quaternion w x y z on the straight line between two."""
    w, x = first[0] + share * (second[0] - first[0]), first[1] + share * (second[1] - first[1])
    y, z = first[2] + share * (second[2] - first[2]), first[3] + share * (second[3] - first[3])
    size = np.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w / size, x / size, y / size, z / size
    out = np.empty((3, 3))
    out[0, 0], out[0, 1] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z)
    out[0, 2], out[1, 0] = 2 * (x * z + w * y), 2 * (x * y + w * z)
    out[1, 1], out[1, 2] = 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    out[2, 0], out[2, 1] = 2 * (x * z - w * y), 2 * (y * z + w * x)
    out[2, 2] = 1 - 2 * (x * x + y * y)
    return out


@compiled(pairs, numbers, numbers, number)
def turned(rotation: Array, rates: Array, next_rates: Array, dt_s: float) -> Array:
    """A rotation (3, 3) after a time, by the mean of the rates (3,) at its ends."""
    half = 0.5 * dt_s
    return _product(rotation, _rotation(
        half * (rates[0] + next_rates[0]), half * (rates[1] + next_rates[1]),
        half * (rates[2] + next_rates[2]),
    ))  # fmt: skip


@compiled(pairs, pairs, numbers, numbers, numbers, number, number)
def led_level(
    rotation: Array, autopilot: Array, rates: Array, next_rates: Array, bias: Array, dt_s: float,
    lead: float,
) -> tuple[Array, float]:  # fmt: skip
    """Attitude (3, 3) after a time, as of `SteadyLevel.of`, and how far it was from the level.

    It is turned by the mean of the rates (3,) at the ends less their bias, then about the vertical
    to the heading of the `autopilot` (3, 3), then by the ratio `lead` of what is left towards it.
    """
    x, y = 0.5 * (rates[0] + next_rates[0]) - bias[0], 0.5 * (rates[1] + next_rates[1]) - bias[1]
    z = 0.5 * (rates[2] + next_rates[2]) - bias[2]
    now = _product(rotation, _rotation(dt_s * x, dt_s * y, dt_s * z))
    sine, cosine = 0.0, 0.0
    for k in range(3):
        sine += autopilot[1, k] * now[0, k] - autopilot[0, k] * now[1, k]
        cosine += autopilot[0, k] * now[0, k] + autopilot[1, k] * now[1, k]
    heading = np.arctan2(sine, cosine)
    c, s = np.cos(heading), np.sin(heading)
    for k in range(3):
        north, east = now[0, k], now[1, k]
        now[0, k], now[1, k] = c * north - s * east, s * north + c * east
    x, y, z = _vector(_product(autopilot, now.T))
    return _product(_rotation(lead * x, lead * y, lead * z), now), np.hypot(x, y)


@compiled(pairs, numbers, numbers, pairs, number, pairs_out, pairs_out)
def integrated(
    rotation: Array, acceleration: Array, gravity: Array, before: Array, dt_s: float,
    velocity: Array, displacement: Array,
) -> Array:  # fmt: skip
    """Acceleration in NED and its derivative by the bias, rows (4, 3), of a sample (3,).

    The trapezoidal rule adds them to the integrals `velocity` and `displacement`, rows (4, 3),
    which change, over a time since the sample `before` (4, 3), if any; displacement with
    acceleration linear since then.
    """
    now = np.empty((4, 3))
    for k in range(3):
        now[0, k] = gravity[k] + (
            rotation[k, 0] * acceleration[0]
            + rotation[k, 1] * acceleration[1]
            + rotation[k, 2] * acceleration[2]
        )
        for i in range(3):
            now[1 + i, k] = -rotation[i, k]
    if dt_s > 0.0:
        for i in range(4):
            for k in range(3):
                displacement[i, k] += velocity[i, k] * dt_s + (
                    (2.0 * before[i, k] + now[i, k]) * (dt_s * dt_s / 6.0)
                )
                velocity[i, k] += (before[i, k] + now[i, k]) * (dt_s / 2.0)
    return now
