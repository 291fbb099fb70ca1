"""Optical flow of each frame that somebody wants: the autopilot, or navigation after a lift-off."""

from __future__ import annotations

from collections.abc import Iterator

from companion.estimation.attitude.camera_attitude import CameraAttitude
from companion.estimation.attitude_checks import AttitudeChecks
from companion.estimation.lift_off.ground_aiding import GroundAiding
from companion.estimation.lift_off.optical_flow import FlowMeter
from companion.messages import Frame, Message
from companion.timing.clock import Timer


class FlowOfFrames:
    """Measures flow where `asked` by the autopilot, or where it aids up to a metric map."""

    def __init__(
        self, asked: bool, meter: FlowMeter, ground: GroundAiding, attitude: CameraAttitude,
        checks: AttitudeChecks, times: Timer,
    ) -> None:  # fmt: skip
        self._asked, self._meter, self._ground = asked, meter, ground
        self._attitude, self._checks, self._times = attitude, checks, times

    def of(self, frame: Frame) -> Iterator[Message]:
        """Flow to send, and warnings where it contradicts the accelerometers."""
        wanted = self._ground.wants_flow(frame.t_ns)
        if not self._asked and not wanted:
            return
        with self._times("optical flow"):
            flow = self._meter.step(frame, self._attitude)
        over_ground = self._meter.over_ground
        if (
            wanted and over_ground is not None
            and self._ground.take_flow(over_ground, self._attitude.imu_delay_ns)
        ):  # fmt: skip
            yield from self._checks.contradicted_at_lift_off(frame.t_ns)
        if self._asked:
            yield flow
