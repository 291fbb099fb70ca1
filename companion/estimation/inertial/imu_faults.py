"""Faults that the IMU's own samples show: rate, values that repeat, ends of its range, unit."""

from __future__ import annotations

import numpy as np

from companion.estimation.inertial.imu_comparison import ImuWindow
from companion.geometry.geodesy import STANDARD_GRAVITY_M_S2
from companion.geometry.transforms import Array

LEAST_HZ = 25.0
"""Half of the least that the autopilot is asked for: as if a link lost every other sample."""
RECENT_S, LEAST_SAMPLES = 2.0, 10
"""Time that is looked at, and samples that say anything."""
LEAST_RAIL_M_S2 = 1.5 * STANDARD_GRAVITY_M_S2
"""The narrowest range of accelerometers in autopilots is 2 g; a vehicle in rest measures 1 g."""
AT_RAIL, NEAR_RAIL_M_S2 = 5, 0.3
"""Equal extremes of one axis; and what lies so near them, which at a rail is less than these."""
FROZEN_SHARE = 0.9
"""Share of samples that repeat all three values of the one before."""
DISTINCT = 20
"""Values of an axis that show noise: an axis with one value beside such ones is stuck."""
IN_G = (0.8, 1.25)
"""Mean size of what is gravity in units of g."""
AXES = "xyz"


def fault(window: ImuWindow) -> str | None:
    """Fault of the last two seconds of samples, in words; None where nothing shows."""
    recent = window.imu_s >= window.imu_s[-1] - RECENT_S
    force, gyro = window.accel_m_s2[recent], window.gyro_rad_s[recent]
    if len(force) < LEAST_SAMPLES:
        return None
    rate_hz = 1.0 / max(float(np.median(np.diff(window.imu_s[recent]))), 1e-3)
    if rate_hz < LEAST_HZ:
        return f"it comes at {rate_hz:.0f} Hz: too few, {LEAST_HZ:.0f} are needed"
    if window.imu_s[-1] - window.imu_s[0] < RECENT_S:
        return None
    stuck = _stuck(force, gyro)
    if stuck is not None:
        return stuck
    for axis in range(3):
        rail = _rail_m_s2(force[:, axis])
        if rail is not None:
            return f"it is saturated: its {AXES[axis]} axis ends at {rail:+.1f} m/s2"
    size = float(np.linalg.norm(force, axis=1).mean())
    if IN_G[0] < size < IN_G[1]:
        g = STANDARD_GRAVITY_M_S2
        return f"its accelerations are in g, not in m/s2: {size:.2f} instead of {g:.1f}"
    return None


def _stuck(force: Array, gyro: Array) -> str | None:
    same = np.diff(force, axis=0) == 0.0
    turning = (np.diff(gyro, axis=0) != 0.0).any(axis=1).mean() > 0.5
    if turning and same.all(axis=1).mean() > FROZEN_SHARE:
        return "it is stuck: its accelerations stay the same while its rates change"
    distinct = [len(np.unique(force[:, axis])) for axis in range(3)]
    for axis in range(3):
        others = min(n for i, n in enumerate(distinct) if i != axis)
        if distinct[axis] == 1 and others >= DISTINCT:
            return f"it is stuck: its {AXES[axis]} axis stays at {force[0, axis]:+.1f} m/s2"
    return None


def _rail_m_s2(values: Array) -> float | None:
    """End of the range at which many samples of an axis lie; None where there is none."""
    for extreme in (float(values.max()), float(values.min())):
        off = np.abs(values - extreme)
        at, near = int((off < 1e-6).sum()), int(((off >= 1e-6) & (off < NEAR_RAIL_M_S2)).sum())
        if abs(extreme) >= LEAST_RAIL_M_S2 and at >= AT_RAIL and at > near:
            return extreme
    return None
