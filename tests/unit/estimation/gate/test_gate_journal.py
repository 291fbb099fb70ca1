"""The journal of the pose gate gives the poses that it gave."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from companion.config import MEASUREMENTS, FeedbackConfig, Measurement
from companion.estimation.gate.gate_journal import POSE, given_again
from companion.estimation.gate.pose_journal import JournaledPoseGate, PoseGateAgain
from companion.estimation.gate.pose_to_send import PoseToSend
from companion.estimation.gate.reset_counter import ResetCounter
from companion.flight_notes import GateStep
from companion.geometry.transforms import Pose, quaternion_from_euler, rotation_from_quaternion
from companion.messages import Odometry, TrackState
from companion.telemetry import AttitudeSample
from drivers.recording.recording_codec import decision_bytes
from tests.support.flights.recorded_steps import recorded

MS = 1_000_000


@dataclass
class Flight:
    """A flight of the gate: gaps, resets, a boot of the autopilot, changed limits."""

    rng: np.random.Generator
    steps: list[GateStep] = field(default_factory=list)
    attitudes: list[AttitudeSample] = field(default_factory=list)
    odometry: dict[int, Odometry] = field(default_factory=dict)
    given: list[PoseToSend] = field(default_factory=list)
    now_ns: int = 10**12
    heard: bool = True
    use: tuple[Measurement, ...] = MEASUREMENTS

    def fly(self, n_frames: int) -> None:
        config = FeedbackConfig(mode="odometry")
        counter = ResetCounter()

        def may_start(now_ns: int) -> str:
            if self.rng.random() < 0.3:
                return "disk is slow"
            if self.rng.random() < 0.2:
                counter.booted(int(self.rng.integers(1, 255)))
            return ""

        gate = JournaledPoseGate(
            config, counter, lambda t_ns: -12.5 + 1e-10 * (t_ns - 10**12), may_start,
            lambda: self.now_ns, lambda: self.heard, self.steps.append,
        )  # fmt: skip
        gate.begin(self.use)
        reset = 0
        for seq in range(n_frames):
            self.heard = self.rng.random() < 0.95
            for _ in range(3):
                self.now_ns += 11 * MS
                self._attitude(gate)
                self._poll(gate)
            event = self.rng.random()
            if event < 0.002:
                gate.autopilot_booted(None)
            elif event < 0.004:
                config = replace(config, max_sigma_m=config.max_sigma_m * 1.01)
                gate.reconfigure(config)
            elif event < 0.006:
                gate.withhold("switched off")
            elif event < 0.008:
                reset += 1
            elif event < 0.012:
                self.now_ns += 700 * MS
                continue
            odometry = self._odometry(seq, reset)
            self.odometry[seq] = odometry
            self._came(gate.take(odometry, self.now_ns))

    def _poll(self, gate: JournaledPoseGate) -> None:
        for _ in range(2):
            self.now_ns += 2 * MS
            self._came(gate.due(self.now_ns))

    def _came(self, pose: PoseToSend | None) -> None:
        if pose is not None:
            self.given.append(pose)

    def _attitude(self, gate: JournaledPoseGate) -> None:
        turned = quaternion_from_euler(0.02, -0.03, 1e-9 * (self.now_ns - 10**12) * 0.2)
        sample = AttitudeSample(self.now_ns - 5 * MS, turned, np.array([0.0, 0.0, 0.2]))
        self.attitudes.append(sample)
        gate.take_attitude(sample)

    def _odometry(self, seq: int, reset: int) -> Odometry:
        t_ns = self.now_ns - 25 * MS
        yaw = 1e-9 * (t_ns - 10**12) * 0.2
        rotation = rotation_from_quaternion(quaternion_from_euler(0.02, -0.03, yaw))
        place = np.array([0.3 * seq, -0.1, -4.0]) + self.rng.normal(0, 0.01, 3)
        lost = self.rng.random() < 0.01
        return Odometry(
            seq, t_ns, TrackState.LOST if lost else TrackState.TRACKING, reset, 80,
            None if lost else Pose(rotation, place), np.array([3.0, 0.0, 0.1]), 0.05, 0.1, 0.01,
            0.02,
        )  # fmt: skip


def made_again(flight: Flight, steps: list[GateStep]) -> list[PoseToSend]:
    config = FeedbackConfig(mode="odometry")
    gate = PoseGateAgain(config, flight.use, flight.odometry.__getitem__)
    made = given_again({POSE: gate}, steps, flight.attitudes)
    return [pose for _, pose in made if isinstance(pose, PoseToSend)]


@pytest.mark.parametrize("n", range(2))
def test_the_poses_come_again_from_what_was_recorded(n: int) -> None:
    flight = Flight(np.random.default_rng(n), use=MEASUREMENTS if n else ("attitude",))
    flight.fly(1500)
    assert len(flight.given) > 300
    assert any(pose.predicted for pose in flight.given)
    assert len({pose.reset_counter for pose in flight.given}) > 1
    again = made_again(flight, [recorded(step) for step in flight.steps])
    assert len(again) == len(flight.given)
    for ours, given in zip(again, flight.given, strict=True):
        assert ours.t_ns == given.t_ns and ours.reset_counter == given.reset_counter
        assert (ours.world_from_body.translation == given.world_from_body.translation).all()
        assert (ours.world_from_body.rotation == given.world_from_body.rotation).all()
        assert (ours.velocity_world_m_s == given.velocity_world_m_s).all()
        assert ours.sigma_position_m == given.sigma_position_m


def test_a_step_that_is_missing_shows() -> None:
    flight = Flight(np.random.default_rng(7))
    flight.fly(1000)
    steps = [step for step in flight.steps if step.what != "due"]
    assert len(made_again(flight, steps)) < len(flight.given)


def test_attitudes_that_are_not_believed_are_counted_and_allow_no_pose() -> None:
    flight = Flight(np.random.default_rng(3), use=("imu", "satellites"))
    flight.fly(300)
    assert flight.steps[-1].n_samples == len(flight.attitudes) == 900
    assert flight.given == made_again(flight, [recorded(step) for step in flight.steps]) == []


def test_steps_are_read_back_to_the_last_bit() -> None:
    step = GateStep(123, POSE, "frame", 4, True, {"seq": 9, "down_m": -0.1234567890123456789})
    assert json.loads(decision_bytes(step))["values"]["down_m"] == -0.1234567890123456789
    assert recorded(step) == step
