"""Constant-velocity motion filter.

The only file that knows filterpy.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from filterpy.kalman import KalmanFilter

from companion.geometry.transforms import (
    Array,
    Pose,
    interpolate_rotation,
    nearest_rotation,
    rotation_from_vector,
    vector_from_rotation,
)

ACCELERATION, SIGMA_POSITION = 0.3, 0.003
ACCELERATION_NO_ATTITUDE, SIGMA_POSITION_NO_ATTITUDE = 1.5, 0.002
"""Process and measurement noise in map units, one of which is about the scene distance, with and
without attitude."""
MAX_RATE_SPAN_NS = 300_000_000
"""Over longer spans a drone may turn this way and back."""
NORMALISED_TAU_S = 0.5
"""Over which innovations are averaged: a copter brakes and turns within two seconds."""
VARIANCE_ALIGNMENT_RAD2 = 1e-4
"""Variance of `map_from_ned` after one image: 0.6 degrees."""


class MotionFilter:
    """Error-state Kalman filter over position, velocity (map units) and attitude error.

    Constant velocity, and a slowly drifting rotation `map_from_ned`, by which the attitude of the
    autopilot predicts that of the camera even where its yaw has drifted. That rotation is kept
    outside the state; x = [position (3), velocity (3), rotation vector (3), rad, map axes] holds
    its correction, which is composed with it and reset to zero (Sola, Quaternion kinematics for the
    error-state Kalman filter, 2017). Without attitude the last angular rate is held.
    """

    def __init__(self) -> None:
        self._t_ns: int | None = None
        self._poses: deque[tuple[int, Pose]] = deque(maxlen=2)
        self._filter: KalmanFilter | None = None
        self._map_from_ned = np.eye(3)
        self._aligned = False
        """True once `map_from_ned` is known."""
        self._normalised = 1.0
        """Mean squared innovation of the position per degree of freedom, of late."""

    def reset(self) -> None:
        """Reset all but the attitude alignment itself."""
        self._t_ns, self._filter, self._aligned = None, None, False
        self._poses.clear()

    @property
    def aligned(self) -> bool:
        """True once `map_from_ned` is known."""
        return self._aligned

    @property
    def velocity(self) -> tuple[Array, float] | None:
        """Velocity (3,) in map units per second and its standard deviation; None until known.

        A map that began near the ground has a unit that is small beside what the camera sees from
        above, and its motion and noise are larger in it than assumed: as much as innovations show.
        """
        if self._filter is None:
            return None
        variance = max(1.0, self._normalised) * float(np.diag(self._filter.P)[3:6].max())
        return self._filter.x.ravel()[3:6].copy(), float(np.sqrt(max(variance, 0.0)))

    @property
    def rates_camera_rad_s(self) -> Array | None:
        """Angular rate (3,) of the camera in its axes between the last two images.

        None where unknown.
        """
        if len(self._poses) < 2:
            return None
        (t0, a), (t1, b) = self._poses
        if not 0 < t1 - t0 < MAX_RATE_SPAN_NS:
            return None
        return vector_from_rotation(a.rotation.T @ b.rotation) / ((t1 - t0) * 1e-9)

    def predict(self, t_ns: int, ned_from_camera: Array | None) -> Pose | None:
        """Predicted `map_from_camera`; None when unknown."""
        if self._filter is None or self._t_ns is None:
            return None
        dt = (t_ns - self._t_ns) * 1e-9
        x = self._filter.x.ravel()
        position = x[:3] + np.clip(dt, 0.0, 1.0) * x[3:6]
        if ned_from_camera is not None and self._aligned:
            return Pose(self._map_from_ned @ ned_from_camera, position)
        (t0, a), (t1, b) = self._poses[0], self._poses[-1]
        if t1 == t0 or dt > 1.0:
            return Pose(b.rotation, position)
        return Pose(interpolate_rotation(a.rotation, b.rotation, (t_ns - t0) / (t1 - t0)), position)

    def correct_map(self, before: Pose, after: Pose, scale: float = 1.0) -> None:
        """Apply a correction of the map that moved the last `map_from_camera`."""
        if self._filter is None:
            return
        correction = nearest_rotation(after.rotation @ before.rotation.T)
        x = self._filter.x.ravel().copy()
        x[:3] = after.translation + scale * correction @ (x[:3] - before.translation)
        x[3:6] = scale * correction @ x[3:6]
        self._map_from_ned = nearest_rotation(correction @ self._map_from_ned)
        self._filter.x = x.reshape(-1, 1)
        change = np.zeros((9, 9))
        change[:3, :3] = change[3:6, 3:6] = scale * correction
        change[6:, 6:] = correction
        self._filter.P = change @ self._filter.P @ change.T
        moved = [
            (t_ns, Pose(
                correction @ pose.rotation,
                after.translation + scale * correction @ (pose.translation - before.translation),
            ))
            for t_ns, pose in self._poses
        ]  # fmt: skip
        self._poses.clear()
        self._poses.extend(moved)

    def correct_attitude(self, old_from_new: Array) -> None:
        """Apply a change of the attitude to `map_from_ned`."""
        self._map_from_ned = nearest_rotation(self._map_from_ned @ old_from_new)

    def discard_alignment(self) -> None:
        """Invalidate `map_from_ned`: the attitude was not that of the camera."""
        self._aligned = False

    def correct(self, t_ns: int, map_from_camera: Pose, ned_from_camera: Array | None) -> None:
        """Update with the pose of an image."""
        seen = np.eye(3)
        if ned_from_camera is not None:
            seen = nearest_rotation(map_from_camera.rotation @ ned_from_camera.T)
        if self._filter is None or self._t_ns is None or t_ns - self._t_ns > 2_000_000_000:
            self._filter, self._normalised = self._initial_filter(map_from_camera.translation), 1.0
            self._map_from_ned, self._aligned = seen, ned_from_camera is not None
        else:
            dt = max((t_ns - self._t_ns) * 1e-9, 1e-3)
            f = self._filter
            f.F = np.eye(9)
            f.F[:3, 3:6] = dt * np.eye(3)
            q = np.zeros((9, 9))
            has_attitude = ned_from_camera is not None
            accel = ACCELERATION if has_attitude else ACCELERATION_NO_ATTITUDE
            sigma = SIGMA_POSITION if has_attitude else SIGMA_POSITION_NO_ATTITUDE
            q[:3, :3] = np.eye(3) * accel**2 * dt**4 / 4
            q[:3, 3:6] = q[3:6, :3] = np.eye(3) * accel**2 * dt**3 / 2
            q[3:6, 3:6] = np.eye(3) * accel**2 * dt**2
            q[6:, 6:] = np.eye(3) * np.radians(1.0) ** 2 * dt
            f.Q = q
            f.predict()
            rows = 6 if ned_from_camera is not None else 3
            h = np.zeros((rows, 9))
            h[:3, :3] = np.eye(3)
            r = np.eye(rows) * sigma**2
            z = map_from_camera.translation
            if ned_from_camera is not None:
                h[3:, 6:] = np.eye(3)
                r[3:, 3:] = np.eye(3) * np.radians(0.3) ** 2
                if not self._aligned:  # first attitude in this map
                    self._map_from_ned, self._aligned = seen, True
                    f.P[6:], f.P[:, 6:] = 0.0, 0.0
                    f.P[6:, 6:] = VARIANCE_ALIGNMENT_RAD2 * np.eye(3)
                correction = vector_from_rotation(seen @ self._map_from_ned.T)
                z = np.r_[z, correction]
            f.update(z.reshape(-1, 1), R=r, H=h)
            innovation = f.y[:3, 0]
            squared = float(innovation @ np.linalg.solve(f.S[:3, :3], innovation)) / 3.0
            self._normalised += (1.0 - np.exp(-dt / NORMALISED_TAU_S)) * (
                squared - self._normalised
            )
            rotated = rotation_from_vector(f.x[6:9, 0])
            self._map_from_ned = nearest_rotation(rotated @ self._map_from_ned)
            f.x[6:9] = 0.0
        self._t_ns = t_ns
        self._poses.append((t_ns, map_from_camera))

    def _initial_filter(self, position: Array) -> KalmanFilter:
        f = KalmanFilter(dim_x=9, dim_z=6)
        f.x = np.r_[position, np.zeros(6)].reshape(-1, 1)
        lengths = np.r_[np.full(3, 1e-4), np.ones(3)]
        f.P = np.diag(np.r_[lengths, np.full(3, VARIANCE_ALIGNMENT_RAD2)])
        return f
