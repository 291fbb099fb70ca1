"""Attitudes from an IMU alone, for recordings without an autopilot's.

Gyroscopes are integrated; what they drift by is led back to the vertical that accelerometers show
on average (the complementary filter of Mahony, Hamel, Pflimlin, 2008, with a bias).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.geometry.geodesy import STANDARD_GRAVITY_M_S2
from companion.geometry.transforms import Array

LEAD_HZ = 0.02
"""Gain of the tilt, a fiftieth in a second: over a minute a drone's accelerations average out, and
a stronger lead would turn the attitude by each of them. At first, where the bias is not known of a
stand, one over the time. That of the bias is critically damped, a quarter of its square."""
BEGIN_S = 0.5
"""At the begin, of which the vertical is the mean."""
STILL_RAD_S, STILL_M_S2 = 0.02, 0.3
"""Scatter below which it stands then: the mean rate is the gyroscopes' bias."""
MAX_OFF_G = 0.3
"""Specific force may differ by so much from gravity to show a vertical."""
MAX_GAP_S = 0.5
"""Over longer ones nothing is integrated."""


class ImuAttitudes(NamedTuple):
    """Quaternions `ned_from_body` (N, 4), wxyz, and body rates (N, 3) without their bias, rad/s.

    The heading is anybody's: zero at first.
    """

    ned_from_body: Array
    rates_rad_s: Array


def attitudes_by_imu(t_ns: NDArray[np.int64], gyro_rad_s: Array, accel_m_s2: Array) -> ImuAttitudes:
    """Attitudes at N times in ascending order, of rates and specific forces (N, 3).

    Axes of the body may lie in any way; the vertical is down where specific force points up.
    """
    begin = np.asarray(t_ns - t_ns[0] <= BEGIN_S * 1e9)
    still = max(gyro_rad_s[begin].std(0)) < STILL_RAD_S and (
        max(accel_m_s2[begin].std(0)) < STILL_M_S2
    )
    bx, by, bz = gyro_rad_s[begin].mean(0).tolist() if still else (0.0, 0.0, 0.0)
    w, x, y, z = _upright(-accel_m_s2[begin].mean(0))
    attitudes, rates = np.empty((len(t_ns), 4)), np.empty((len(t_ns), 3))
    steps_s = np.diff(t_ns, prepend=t_ns[0]) * 1e-9
    forces = np.linalg.norm(accel_m_s2, axis=1)
    shows = np.abs(forces / STANDARD_GRAVITY_M_S2 - 1.0) < MAX_OFF_G
    downs = -accel_m_s2 / np.maximum(forces, 1e-9)[:, None]
    # plain numbers: two hundred samples a second, and arrays of three are slow
    since_s = 0.0
    for k, (gyro, down, dt) in enumerate(
        zip(gyro_rad_s.tolist(), downs.tolist(), steps_s.tolist(), strict=True)
    ):
        ex = ey = ez = 0.0
        since_s += dt
        lead = LEAD_HZ if still else max(LEAD_HZ, 1.0 / (1.0 + since_s))
        if shows[k] and dt < MAX_GAP_S:
            ox, oy, oz = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
            ex = down[1] * oz - down[2] * oy
            ey = down[2] * ox - down[0] * oz
            ez = down[0] * oy - down[1] * ox
            gain = 0.25 * lead * lead * dt
            bx, by, bz = bx - gain * ex, by - gain * ey, bz - gain * ez
        rates[k] = rx, ry, rz = gyro[0] - bx, gyro[1] - by, gyro[2] - bz
        if dt < MAX_GAP_S:
            half = 0.5 * dt
            hx, hy, hz = (half * (rate + lead * e) for rate, e in ((rx, ex), (ry, ey), (rz, ez)))
            w, x, y, z = (
                w - x * hx - y * hy - z * hz, x + w * hx + y * hz - z * hy,
                y + w * hy + z * hx - x * hz, z + w * hz + x * hy - y * hx,
            )  # fmt: skip
            norm = (w * w + x * x + y * y + z * z) ** 0.5
            w, x, y, z = w / norm, x / norm, y / norm, z / norm
        attitudes[k] = w, x, y, z
    return ImuAttitudes(attitudes, rates)


def _upright(down_body: Array) -> tuple[float, float, float, float]:
    """The least rotation that brings a direction (3,) of the body down."""
    dx, dy, dz = (down_body / max(float(np.linalg.norm(down_body)), 1e-9)).tolist()
    if dz < -0.999999:
        return 0.0, 1.0, 0.0, 0.0
    quaternion = np.array([1.0 + dz, dy, -dx, 0.0])
    w, x, y, z = (quaternion / np.linalg.norm(quaternion)).tolist()
    return w, x, y, z
