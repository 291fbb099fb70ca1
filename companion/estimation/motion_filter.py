"""What is believed of the camera's motion between images: attitude history and motion filter.

The only file that knows filterpy.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from collections import deque

import numpy as np
from filterpy.kalman import KalmanFilter

from companion.geometry.transforms import (
    Array,
    Pose,
    interpolate_rotation,
    nearest_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
    vector_from_rotation,
)
from companion.messages import AttitudeSample

MAX_GAP_NS = 500_000_000
MAX_EXTRAPOLATION_NS = 120_000_000
"""Beyond, a craft in gusts turns otherwise by degrees, and what images tell goes on more truly."""
ACCELERATION, SIGMA_POSITION = 0.3, 0.003
ACCELERATION_UNTOLD, SIGMA_POSITION_UNTOLD = 1.5, 0.002
"""In map units, one of which is about the distance of what is seen, with and without attitude."""


VARIANCE_TIED_RAD2 = 1e-4
"""Of how the map's axes lie to the autopilot's, when one image has told: 0.6 degrees."""


class AttitudeHistory:
    """The recent past of the autopilot's attitude, read at any time within it."""

    def __init__(self, keep: int = 4000, max_gap_ns: int = MAX_GAP_NS) -> None:
        self._keep, self._max_gap_ns = keep, max_gap_ns
        self._samples: list[AttitudeSample] = []
        self._times: list[int] = []

    def add(self, sample: AttitudeSample) -> None:
        """Take a sample; late ones are put in their place, doubles ignored."""
        if not self._times or sample.t_ns > self._times[-1]:
            self._times.append(sample.t_ns)
            self._samples.append(sample)
        else:
            at = bisect_left(self._times, sample.t_ns)
            if self._times[at] == sample.t_ns:
                return
            insort(self._times, sample.t_ns)
            self._samples.insert(at, sample)
        if len(self._times) > 2 * self._keep:
            del self._times[: -self._keep], self._samples[: -self._keep]

    @property
    def newest_t_ns(self) -> int:
        """Time of the last sample; 0 before the first."""
        return self._times[-1] if self._times else 0

    def with_rates_at(self, t_ns: int, step_ns: int) -> tuple[Array, Array] | None:
        """`ned_from_body` (3, 3) and body rates (3,) in rad/s from a step before to one after."""
        here = self.at(t_ns)
        before, after = self.at(t_ns - step_ns), self.at(t_ns + step_ns)
        if here is None or before is None or after is None:
            return None
        return here, vector_from_rotation(before.T @ after) / (2e-9 * step_ns)

    def at(self, t_ns: int) -> Array | None:
        """Rotation `ned_from_body` (3, 3) at a time; None where no sample is near enough."""
        if not self._times:
            return None
        i = bisect_left(self._times, t_ns)
        if 0 < i < len(self._times):
            before, after = self._samples[i - 1], self._samples[i]
            span = after.t_ns - before.t_ns
            if span > self._max_gap_ns:
                return None
            return interpolate_rotation(
                rotation_from_quaternion(before.ned_from_body),
                rotation_from_quaternion(after.ned_from_body),
                (t_ns - before.t_ns) / span,
            )
        nearest = self._samples[0] if i == 0 else self._samples[-1]
        gap_ns = t_ns - nearest.t_ns
        if abs(gap_ns) > MAX_EXTRAPOLATION_NS:
            return None
        rotation = rotation_from_quaternion(nearest.ned_from_body)
        if nearest.rates_body_rad_s is None:
            return rotation
        turned: Array = rotation @ rotation_from_vector(nearest.rates_body_rad_s * (gap_ns * 1e-9))
        return turned


class MotionFilter:
    """Error-state Kalman filter over position, velocity (map units) and the attitude's error.

    Constant velocity, and a rotation `map_from_ned` that wanders slowly, by which the autopilot's
    attitude predicts the camera's rotation even where its yaw has drifted. That rotation is kept
    apart; x = [position (3), velocity (3), turn (3)] holds what an update turns it by, a rotation
    vector (rad) in the map's axes: composed with it, and zero again (Sola, Quaternion kinematics
    for the error-state Kalman filter, 2017). Without attitude the last turn rate is held.
    """

    def __init__(self) -> None:
        self._t_ns: int | None = None
        self._poses: deque[tuple[int, Pose]] = deque(maxlen=2)
        self._filter: KalmanFilter | None = None
        self._map_from_ned = np.eye(3)
        self._tied = False
        """Whether `map_from_ned` is known: how the map's axes lie to the autopilot's."""
        self.unit = 1.0

    def reset(self) -> None:
        """Forget everything but what is known of the autopilot's attitude."""
        self._t_ns, self._filter, self._tied = None, None, False
        self._poses.clear()

    @property
    def tied(self) -> bool:
        """Whether it is known how the map's axes lie to the autopilot's."""
        return self._tied

    @property
    def velocity(self) -> tuple[Array, float] | None:
        """Velocity (3,) in map units per second and its standard deviation; None until known."""
        if self._filter is None:
            return None
        variance = float(np.diag(self._filter.P)[3:6].max())
        return self._filter.x.ravel()[3:6].copy(), float(np.sqrt(max(variance, 0.0)))

    def predict(self, t_ns: int, ned_from_camera: Array | None) -> Pose | None:
        """Predicted `map_from_camera`; None when nothing is known."""
        if self._filter is None or self._t_ns is None:
            return None
        dt = (t_ns - self._t_ns) * 1e-9
        x = self._filter.x.ravel()
        position = x[:3] + np.clip(dt, 0.0, 1.0) * x[3:6]
        if ned_from_camera is not None and self._tied:
            return Pose(self._map_from_ned @ ned_from_camera, position)
        (t0, a), (t1, b) = self._poses[0], self._poses[-1]
        if t1 == t0 or dt > 1.0:
            return Pose(b.rotation, position)
        return Pose(interpolate_rotation(a.rotation, b.rotation, (t_ns - t0) / (t1 - t0)), position)

    def map_moved(self, before: Pose, after: Pose, scale: float = 1.0) -> None:
        """The map was corrected: the last `map_from_camera` was `before` and is now `after`."""
        if self._filter is None:
            return
        turn = nearest_rotation(after.rotation @ before.rotation.T)
        x = self._filter.x.ravel().copy()
        x[:3] = after.translation + scale * turn @ (x[:3] - before.translation)
        x[3:6] = scale * turn @ x[3:6]
        self._map_from_ned = nearest_rotation(turn @ self._map_from_ned)
        self._filter.x = x.reshape(-1, 1)
        change = np.zeros((9, 9))
        change[:3, :3] = change[3:6, 3:6] = scale * turn
        change[6:, 6:] = turn
        self._filter.P = change @ self._filter.P @ change.T
        moved = [
            (t_ns, Pose(
                turn @ pose.rotation,
                after.translation + scale * turn @ (pose.translation - before.translation),
            ))
            for t_ns, pose in self._poses
        ]  # fmt: skip
        self._poses.clear()
        self._poses.extend(moved)

    def attitude_corrected(self, old_from_new: Array) -> None:
        """The attitude was given as `old`; what it is now takes this turn before the old error."""
        self._map_from_ned = nearest_rotation(self._map_from_ned @ old_from_new)

    def untie(self) -> None:
        """The attitude so far was not the camera's: how the map lies to it is not known."""
        self._tied = False

    def correct(self, t_ns: int, map_from_camera: Pose, ned_from_camera: Array | None) -> None:
        """Take the pose that the image gave."""
        seen = np.eye(3)
        if ned_from_camera is not None:
            seen = nearest_rotation(map_from_camera.rotation @ ned_from_camera.T)
        if self._filter is None or self._t_ns is None or t_ns - self._t_ns > 2_000_000_000:
            self._filter = self._fresh(map_from_camera.translation)
            self._map_from_ned, self._tied = seen, ned_from_camera is not None
        else:
            dt = max((t_ns - self._t_ns) * 1e-9, 1e-3)
            f = self._filter
            f.F = np.eye(9)
            f.F[:3, 3:6] = dt * np.eye(3)
            q = np.zeros((9, 9))
            told = ned_from_camera is not None
            accel = (ACCELERATION if told else ACCELERATION_UNTOLD) * self.unit
            sigma = (SIGMA_POSITION if told else SIGMA_POSITION_UNTOLD) * self.unit
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
                if not self._tied:  # told for the first time in this map
                    self._map_from_ned, self._tied = seen, True
                    f.P[6:], f.P[:, 6:] = 0.0, 0.0
                    f.P[6:, 6:] = VARIANCE_TIED_RAD2 * np.eye(3)
                turn = vector_from_rotation(seen @ self._map_from_ned.T)
                z = np.r_[z, turn]
            f.update(z.reshape(-1, 1), R=r, H=h)
            turned = rotation_from_vector(f.x[6:9, 0])
            self._map_from_ned = nearest_rotation(turned @ self._map_from_ned)
            f.x[6:9] = 0.0
        self._t_ns = t_ns
        self._poses.append((t_ns, map_from_camera))

    def _fresh(self, position: Array) -> KalmanFilter:
        f = KalmanFilter(dim_x=9, dim_z=6)
        f.x = np.r_[position, np.zeros(6)].reshape(-1, 1)
        lengths = np.r_[np.full(3, 1e-4), np.ones(3)] * self.unit**2
        f.P = np.diag(np.r_[lengths, np.full(3, VARIANCE_TIED_RAD2)])
        return f
