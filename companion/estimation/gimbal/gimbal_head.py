"""The head of a gimbal, which the estimation takes for the body, and the body's pose out of that.

A camera is fixed to the gimbal's head as another is to the body: with the head's attitude in place
of the body's, all that holds of a fixed camera holds of this one. The head's attitude in NED comes
of the gimbal, and of the autopilot's heading where its yaw is from there. Accelerations in NED are
the same for both, but for the lever between them. What is given out is the pose of the body, by the
head's attitude and the autopilot's, and only while both are known.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np

from companion.estimation.attitude.attitude_history import AttitudeHistory
from companion.geometry.gimbal import Gimbal
from companion.geometry.transforms import (
    Array,
    Pose,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
    vector_from_rotation,
    yaw_rotation,
)
from companion.messages import Odometry, TrackState, Warned
from companion.telemetry import AttitudeSample, GimbalSample, PositionSample

MAX_RATE_SPAN_NS = 300_000_000
"""Samples further apart say nothing of the rate; gimbals send 5 a second at least."""
RATE_STEP_NS = 60_000_000
"""Over which the body's rate is measured: three attitudes at 50 a second."""
MAX_CORRECTION_SPAN_NS = 200_000_000
"""Over longer spans the rates of its ends say nothing."""
MAX_WAITING = 64
SILENT_NS = 500_000_000
"""Frames without the head's attitude for so long are reported."""

GIMBAL_SILENT = "the gimbal's angles are not known: no vision position"
GIMBAL_HEARD = "the gimbal's angles are known again"


class GimbalHead:
    """Attitudes of autopilot and gimbal in; those of the head out, and poses of the body."""

    def __init__(self, gimbal: Gimbal) -> None:
        self._place_body_m = np.array(gimbal.place_body_m)
        self._sigma_rad = float(np.radians(gimbal.sigma_deg))
        self._vehicle = AttitudeHistory(400)
        self._waiting: deque[GimbalSample] = deque(maxlen=MAX_WAITING)
        """Those of which the autopilot's heading is still to come."""
        self._last: tuple[int, Array] | None = None
        self._heard_ns: int | None = None
        self._newest: AttitudeSample | None = None
        """The autopilot's last attitude."""
        self.corrected_rad = 0.0
        """Corrections of the autopilot's heading so far: turns that its own rates do not show."""
        self._unknown_since_ns: int | None = None
        self._reported = False

    def take(self, sample: AttitudeSample | GimbalSample, delay_ns: int) -> list[AttitudeSample]:
        """Attitudes of the head that are known with a sample, by the stamps of the gimbal.

        These are late by `delay_ns`.
        """
        if isinstance(sample, AttitudeSample):
            self._vehicle.add(sample)
            self._see_correction(sample)
        else:
            self._heard_ns = sample.t_ns
            self._waiting.append(sample)
        known = []
        while self._waiting:
            first = self._waiting[0]
            at_ns = first.t_ns - delay_ns
            if not first.yaw_from_north and self._vehicle.newest_t_ns < at_ns:
                break
            self._waiting.popleft()
            ned_from_head = self._in_ned(first, at_ns)
            if ned_from_head is not None:
                known.append(self._with_rates(first.t_ns, ned_from_head))
        return known

    def _see_correction(self, sample: AttitudeSample) -> None:
        last, self._newest = self._newest, sample
        if last is None or not 0 < sample.t_ns - last.t_ns <= MAX_CORRECTION_SPAN_NS:
            return
        if last.rates_body_rad_s is None or sample.rates_body_rad_s is None:
            return
        dt_s = (sample.t_ns - last.t_ns) * 1e-9
        turn = rotation_from_vector(0.5 * dt_s * (last.rates_body_rad_s + sample.rates_body_rad_s))
        by_rates = rotation_from_quaternion(last.ned_from_body) @ turn
        told = rotation_from_quaternion(sample.ned_from_body)
        self.corrected_rad += float(vector_from_rotation(told @ by_rates.T)[2])

    def _in_ned(self, sample: GimbalSample, at_ns: int) -> Array | None:
        rotation = rotation_from_quaternion(sample.level_from_head)
        if sample.yaw_from_north:
            return rotation
        vehicle = self._vehicle.at(at_ns)
        if vehicle is None:
            return None
        heading_rad = float(np.arctan2(vehicle[1, 0], vehicle[0, 0]))
        return np.asarray(yaw_rotation(heading_rad) @ rotation)

    def _with_rates(self, t_ns: int, ned_from_head: Array) -> AttitudeSample:
        """The attitude with the rates since the one before: gimbals do not agree on their axes."""
        last, self._last = self._last, (t_ns, ned_from_head)
        rates = None
        if last is not None and 0 < t_ns - last[0] <= MAX_RATE_SPAN_NS:
            rates = vector_from_rotation(last[1].T @ ned_from_head) / ((t_ns - last[0]) * 1e-9)
        return AttitudeSample(t_ns, quaternion_from_rotation(ned_from_head), rates)

    def body_upright(self, t_ns: int) -> float | None:
        """Cosine of the tilt of the body, which the head has not; None where it is not known."""
        vehicle = self._vehicle.at(t_ns)
        return None if vehicle is None else float(vehicle[2, 2])

    def of_head(self, sample: PositionSample) -> PositionSample:
        """A position as it is for the head; as it was where the body's attitude is not known."""
        vehicle = self._vehicle.at(sample.t_ns)
        if vehicle is None or not self._place_body_m.any():
            return sample
        return replace(sample, position_ned_m=sample.position_ned_m + vehicle @ self._place_body_m)

    def body_of(self, odometry: Odometry, ned_from_head: Array | None) -> Odometry:
        """Odometry of the body by that of the head, with the head's attitude (3, 3) of its time.

        Lost, without a pose, where that, or the autopilot's, is not known.
        """
        head, t_ns = odometry.world_from_body, odometry.t_ns
        if head is None:
            return odometry
        vehicle = self._vehicle.at(t_ns)
        if ned_from_head is None or vehicle is None:
            return Odometry(odometry.seq, t_ns, TrackState.LOST, odometry.reset_counter)
        rotation = head.rotation @ ned_from_head.T @ vehicle
        lever_m = rotation @ self._place_body_m
        velocity = odometry.velocity_world_m_s
        before = self._vehicle.at(t_ns - RATE_STEP_NS)
        if velocity is not None and before is not None:
            rate = rotation @ vector_from_rotation(before.T @ vehicle) / (RATE_STEP_NS * 1e-9)
            velocity = velocity - np.cross(rate, lever_m)
        return replace(
            odometry,
            world_from_body=Pose(rotation, head.translation - lever_m),
            velocity_world_m_s=velocity,
            sigma_position_m=float(
                np.hypot(odometry.sigma_position_m, self._sigma_rad * np.linalg.norm(lever_m))
            ),
            sigma_attitude_rad=float(np.hypot(odometry.sigma_attitude_rad, self._sigma_rad)),
            sigma_yaw_rad=float(np.hypot(odometry.sigma_yaw_rad, self._sigma_rad)),
        )

    def warnings(self, t_ns: int, known: bool) -> list[Warned]:
        """Warnings at a frame at which the head's attitude was known, or not."""
        if known:
            self._unknown_since_ns = None
            if not self._reported:
                return []
            self._reported = False
            return [Warned(t_ns, GIMBAL_HEARD, good=True)]
        if self._unknown_since_ns is None:
            self._unknown_since_ns = t_ns
        if self._reported or t_ns - self._unknown_since_ns < SILENT_NS:
            return []
        self._reported = True
        detail = "none was heard; does the autopilot, or the gimbal, send its attitude?"
        if self._heard_ns is not None:
            detail = f"the last were heard {(t_ns - self._heard_ns) * 1e-9:.1f} s before"
        return [Warned(t_ns, GIMBAL_SILENT, detail)]
