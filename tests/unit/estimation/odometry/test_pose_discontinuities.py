"""A pose that jumps is not sent before it is proven again, at any frame rate."""

from __future__ import annotations

import numpy as np
import pytest

from companion.config import FeedbackConfig
from companion.estimation.body.body_filter import BodyFilter
from companion.estimation.camera_motion import ImageVelocity
from companion.estimation.gate.pose_gate import PoseGate
from companion.estimation.gate.pose_to_send import PoseToSend
from companion.estimation.inertial.acceleration_integral import AccelerationIntegral
from companion.estimation.odometry.smooth_odometry import SmoothOdometry
from companion.geometry.camera import Camera
from companion.geometry.transforms import Pose, Similarity
from companion.messages import Georeference, Track, TrackState
from companion.telemetry import AttitudeSample

CAMERA = Camera(640, 480, 500.0, 500.0, 319.5, 239.5, body_from_camera=Pose.identity())
KNOWN = np.zeros(200, np.int64)
"""Keyframes at which the points of a frame were made: all of them before."""
PLACED = Georeference(Similarity(1.0, np.eye(3), np.zeros(3)), 0.01, 0.01, "GPS", 50, 0.3)
KEYPOINTS_PX = np.random.default_rng(1).uniform(0, 480, (200, 2)).astype(np.float32)
SPEED_M_S = 2.0
TICK_NS, ATTITUDE_NS, LATENCY_NS = 2_000_000, 20_000_000, 40_000_000


class Flight:
    """Northward at constant speed; poses may be off by metres."""

    def __init__(self, rate_hz: float) -> None:
        navigation = BodyFilter(AccelerationIntegral())
        self.odometry = SmoothOdometry(CAMERA, FeedbackConfig().max_jump_m, navigation)
        self.gate = PoseGate(FeedbackConfig(mode="odometry"))
        self.sent: list[tuple[int, PoseToSend]] = []
        self.interrupted = False
        self.reset_counter = 0
        self.period_ns = round(1e9 / rate_hz)
        self.now_ns = 10**12
        self.seq = 0

    def run(self, seconds: float, off_m: float = 0.0, every_other: bool = False) -> None:
        until_ns = self.now_ns + round(seconds * 1e9)
        while self.now_ns < until_ns:
            self.now_ns += TICK_NS
            if self.now_ns % ATTITUDE_NS == 0:
                level = np.array([1.0, 0.0, 0.0, 0.0])
                self.gate.take_attitude(AttitudeSample(self.now_ns, level))
            if self.now_ns - 10**12 >= self.seq * self.period_ns:
                self.seq += 1
                self._frame(off_m if not every_other or self.seq % 2 else 0.0)
            self._keep(self.gate.due(self.now_ns))
            self.interrupted |= not self.gate.sending

    def _frame(self, off_m: float) -> None:
        t_ns = self.now_ns - LATENCY_NS
        north_m = SPEED_M_S * (t_ns - 10**12) * 1e-9
        pose = Pose(np.eye(3), np.array([north_m + off_m, 0.0, -5.0]))
        seen = Track(
            self.seq, t_ns, TrackState.TRACKING, pose, 0, pose, 200, 220, KEYPOINTS_PX,
            sigma_position=0.01, sigma_rotation_rad=0.001,
        )  # fmt: skip
        velocity = ImageVelocity(np.array([SPEED_M_S, 0.0, 0.0]), 0.1)
        found = self.odometry.step(seen, 0, PLACED, velocity, born=KNOWN)
        self.reset_counter = found.reset_counter
        self._keep(self.gate.take(found, self.now_ns))

    def _keep(self, pose: PoseToSend | None) -> None:
        if pose is not None:
            self.sent.append((self.now_ns, pose))

    def off_m(self, pose: PoseToSend) -> float:
        """Distance of a pose from the true position."""
        north_m = SPEED_M_S * (pose.t_ns - 10**12) * 1e-9
        return float(abs(pose.world_from_body.translation[0] - north_m))


@pytest.mark.parametrize("rate_hz", [10, 30, 60, 120])
def test_jump_of_fifty_metres_is_proven_first(rate_hz: float) -> None:
    flight = Flight(rate_hz)
    flight.run(3)
    assert flight.gate.sending
    flight.interrupted = False
    flight.run(4, off_m=50.0)
    before = [(at, pose) for at, pose in flight.sent if flight.off_m(pose) < 1.0]
    after = [(at, pose) for at, pose in flight.sent if flight.off_m(pose) >= 1.0]
    assert len(before) + len(after) == len(flight.sent) and after
    assert flight.interrupted
    assert after[0][0] - before[-1][0] >= 1_000_000_000
    assert all(abs(flight.off_m(pose) - 50.0) < 0.5 for _, pose in after)
    assert {pose.reset_counter for _, pose in before} == {0}
    assert {pose.reset_counter for _, pose in after} == {1}


@pytest.mark.parametrize("rate_hz", [10, 30, 60, 120])
def test_contradicting_positions_are_never_sent(rate_hz: float) -> None:
    """Every other frame is off: neither series is reachable from the other."""
    flight = Flight(rate_hz)
    flight.run(3)
    flight.run(1.5, off_m=50.0, every_other=True)
    assert not [pose for _, pose in flight.sent if flight.off_m(pose) >= 1.0]
    assert flight.reset_counter == 0


@pytest.mark.parametrize("rate_hz", [30, 120])
def test_single_outlier_is_bridged(rate_hz: float) -> None:
    flight = Flight(rate_hz)
    flight.run(3)
    flight.interrupted = False
    flight.run(flight.period_ns * 1e-9, off_m=50.0)
    flight.run(1)
    assert not flight.interrupted
    assert max(flight.off_m(pose) for _, pose in flight.sent) < 1.0
    assert {pose.reset_counter for _, pose in flight.sent} == {0}


def test_pose_rejected_for_long_is_a_reset_even_if_reachable() -> None:
    """After seconds the body may be anywhere, so distance alone would hide the jump."""
    flight = Flight(30)
    flight.run(3)
    for _ in range(12):  # no two of them agree for long
        flight.run(0.2, off_m=200.0)
        flight.run(0.2, off_m=-200.0)
    flight.run(4, off_m=12.0)
    assert flight.sent[-1][1].reset_counter == 1
    assert flight.off_m(flight.sent[-1][1]) == pytest.approx(12.0, abs=0.5)
