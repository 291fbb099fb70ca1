"""Pose gate: bad poses are withheld, good ones sent at the rate and stamps of an autopilot."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from companion.config import FeedbackConfig, Measurement
from companion.estimation.body.limits import SIGMA_JERK_M_S3
from companion.estimation.gate.pose_gate import PoseGate, Sending
from companion.estimation.gate.pose_to_send import PoseToSend
from companion.geometry.transforms import Pose, quaternion_from_euler, rotation_from_quaternion
from companion.messages import Odometry, TrackState
from companion.telemetry import AttitudeSample
from drivers.mavlink.measurements.pose_messages import (
    euler_of,
    odometry_message,
    pose_messages,
    vision_messages,
)

MS = 1_000_000
LATENCY_NS = 40 * MS
ATTITUDE = quaternion_from_euler(0.1, -0.2, 0.7)


def odometry(t_ns: int, **changes: Any) -> Odometry:
    good = Odometry(
        t_ns // (50 * MS), t_ns, TrackState.TRACKING, 0, 80,
        Pose(rotation_from_quaternion(ATTITUDE), np.array([1.0 + t_ns * 1e-9 * 2, 2.0, -3.0])),
        np.array([2.0, 0.0, 0.0]), 0.1, 0.2, 0.01, 0.05,
    )  # fmt: skip
    return replace(good, **changes)


class Flight:
    """Frames every `period_ms`, and the gate polled every 5 ms as in the daemon."""

    def __init__(self, period_ms: int = 50, **config: Any) -> None:
        self.gate = PoseGate(FeedbackConfig(mode="odometry", **config))
        self.period_ns = period_ms * MS
        self.now_ns = 10**12
        self.sent: list[tuple[int, PoseToSend]] = []
        self.yaw_rate_rad_s = 0.0
        self.has_attitude = True
        """Whether the autopilot says its attitude, and how late."""
        self.delay_ns = 0

    def state(self) -> Sending:
        return self.gate.state

    def yaw(self, t_ns: int) -> float:
        return 0.7 + self.yaw_rate_rad_s * (t_ns - 10**12) * 1e-9

    def run(self, seconds: float, frames: bool = True, **changes: Any) -> list[PoseToSend]:
        first = len(self.sent)
        for _ in range(round(seconds * 200)):
            self.now_ns += 5 * MS
            if self.has_attitude and self.now_ns % (20 * MS) == 0:
                at_ns = self.now_ns - self.delay_ns
                attitude = quaternion_from_euler(0.1, -0.2, self.yaw(at_ns))
                self.gate.take_attitude(AttitudeSample(at_ns, attitude))
            if frames and self.now_ns % self.period_ns == 0:
                t_ns = self.now_ns - LATENCY_NS
                sample = odometry(t_ns, **changes)
                if self.yaw_rate_rad_s and sample.world_from_body is not None:
                    turned = quaternion_from_euler(0.1, -0.2, self.yaw(t_ns))
                    at = sample.world_from_body.translation
                    pose = Pose(rotation_from_quaternion(turned), at)
                    sample = replace(sample, world_from_body=pose)
                self._keep(self.gate.take(sample, self.now_ns))
            self._keep(self.gate.due(self.now_ns))
        return [pose for _, pose in self.sent[first:]]

    def _keep(self, pose: PoseToSend | None) -> None:
        if pose is not None:
            self.sent.append((self.now_ns, pose))


def test_nothing_is_sent_before_proof() -> None:
    flight = Flight()
    assert not flight.run(0.9)
    assert flight.gate.why_not == "waiting for proof"
    assert flight.run(0.5)


@pytest.mark.parametrize(("period_ms", "least_hz"), [(100, 30), (50, 30), (30, 30)])
def test_rate_and_order(period_ms: int, least_hz: int) -> None:
    flight = Flight(period_ms)
    flight.run(2)
    poses = flight.run(2)
    assert len(poses) >= 2 * least_hz - 1
    stamps = [pose.t_ns for pose in poses]
    assert all(b > a for a, b in pairwise(stamps))
    # between frames the body goes on as it moved
    off = [p.world_from_body.translation[0] - 1.0 - p.t_ns * 1e-9 * 2 for p in poses]
    assert np.abs(off).max() < 1e-6
    assert any(pose.predicted for pose in poses) == (period_ms > 40)


def test_prediction_rotates_with_the_autopilot() -> None:
    flight = Flight(100)
    flight.yaw_rate_rad_s = 0.5
    flight.run(2)
    poses = [pose for pose in flight.run(1) if pose.predicted]
    assert len(poses) > 10
    for pose in poses:
        assert euler_of(pose.world_from_body.rotation)[2] == pytest.approx(
            flight.yaw(pose.t_ns), abs=2e-3
        )


@pytest.mark.parametrize(
    ("changes", "why_not"),
    [
        ({"state": TrackState.LOST, "world_from_body": None, "quality": -1}, "lost"),
        ({"sigma_position_m": 5.0}, "position too uncertain"),
        ({"sigma_position_m": math.nan}, "position too uncertain"),
        ({"quality": 5}, "quality too low"),
        (
            {"world_from_body": Pose(rotation_from_quaternion(quaternion_from_euler(0.4, -0.2, 2)),
                                     np.zeros(3))},
            "tilt differs from the autopilot's",
        ),
        ({"velocity_world_m_s": np.array([math.nan, 0, 0])}, "position too uncertain"),
    ],
)  # fmt: skip
def test_stops_in_time_and_resumes(changes: dict[str, Any], why_not: str) -> None:
    flight = Flight()
    flight.run(2)
    assert flight.gate.sending
    lost_ns = flight.now_ns
    flight.run(0.6, **changes)
    assert max(at for at, _ in flight.sent) - lost_ns <= 300 * MS
    assert not flight.gate.sending and flight.gate.why_not == why_not
    poses = flight.run(0.9)
    assert not poses
    assert flight.run(0.4)


def test_no_frames_at_all() -> None:
    flight = Flight()
    flight.run(2)
    stopped_ns = flight.now_ns
    flight.run(1, frames=False)
    assert max(at for at, _ in flight.sent) - stopped_ns <= 300 * MS
    assert flight.gate.why_not == "no frames"


def test_single_rejected_frame_is_bridged() -> None:
    flight = Flight()
    flight.run(2)
    flight.run(0.05, state=TrackState.LOST, world_from_body=None)
    assert flight.run(0.5) and flight.gate.sending


def test_old_and_repeated_stamps_are_not_sent() -> None:
    flight = Flight()
    flight.run(2)
    again = odometry(flight.now_ns - 500 * MS)
    assert flight.gate.take(again, flight.now_ns) is None
    late = odometry(flight.now_ns + 1)
    assert flight.gate.take(late, flight.now_ns + 400 * MS) is None


def test_a_measured_pose_that_a_prediction_overtook_is_counted() -> None:
    flight = Flight()
    flight.run(2)
    assert flight.gate.n_overtaken == 0
    sent = flight.run(0.1, frames=False)
    newest = odometry(sent[-1].t_ns - MS)
    assert flight.gate.take(newest, flight.now_ns) is None
    assert flight.gate.sending and flight.gate.n_overtaken == 1


def test_discontinuities_are_counted_across_restarts() -> None:
    flight = Flight()
    flight.run(2)
    assert flight.sent[-1][1].reset_counter == 0
    flight.run(1.5, reset_counter=1)
    assert flight.sent[-1][1].reset_counter == 1
    flight.gate.restart()
    assert not flight.gate.sending
    assert not flight.run(0.9), "belief must hold anew"
    flight.run(2)
    assert flight.sent[-1][1].reset_counter == 2


def test_in_the_map_of_a_process_that_was_killed_poses_go_on_soon() -> None:
    """Localisation has verified it, over several frames, before it says so."""
    flight = Flight()
    flight.run(0.5, state=TrackState.INITIALISING, world_from_body=None)
    flight.gate.map_resumed()
    assert not flight.run(0.3)
    assert flight.run(0.2)


def test_discontinuity_before_the_first_pose_is_not_counted() -> None:
    """Its EKF may take a first counter of 1 for a reset."""
    flight = Flight()
    flight.gate.restart()
    flight.run(0.5)
    flight.run(2, reset_counter=3)
    flight.gate.restart()
    flight.run(2, reset_counter=1)
    assert [flight.sent[0][1].reset_counter, flight.sent[-1][1].reset_counter] == [0, 1]


def test_every_reset_is_proven() -> None:
    flight = Flight()
    flight.run(2)
    reset_ns = flight.now_ns
    flight.run(0.1, reset_counter=1)
    assert not flight.gate.sending and flight.gate.why_not == "waiting for proof"
    poses = flight.run(2, reset_counter=1)
    first_ns = next(at for at, pose in flight.sent if pose.reset_counter)
    assert first_ns - reset_ns >= 1000 * MS
    assert {pose.reset_counter for pose in poses} == {1}


def test_proof_requires_successive_poses() -> None:
    flight = Flight()
    flight.run(0.5)
    flight.run(3, frames=False)
    assert not flight.run(0.9), "half a second before a pause, half a second after it"
    assert flight.run(0.4)


def test_stalled_loop_is_a_gap() -> None:
    """Nothing was polled meanwhile, and a series of frames arrives at once."""
    flight = Flight()
    flight.run(2)
    flight.now_ns += 400 * MS
    assert not flight.run(0.9)
    assert flight.run(0.4)


@pytest.mark.parametrize(("pause_s", "proof_s"), [(0.3, 0.25), (0.6, 0.55), (5.0, 1.0)])
def test_proof_after_missing_frames_lasts_as_long_as_they_were_missing(
    pause_s: float, proof_s: float
) -> None:
    flight = Flight()
    flight.run(2)
    flight.run(pause_s, frames=False)
    assert flight.gate.why_not == "no frames"
    assert not flight.run(proof_s)
    assert flight.run(0.2)
    assert {pose.reset_counter for _, pose in flight.sent} == {0}


@pytest.mark.parametrize(
    "doubt",
    [{"quality": 5}, {"reset_counter": 1}, {"state": TrackState.LOST, "world_from_body": None}],
)
def test_what_is_doubted_after_missing_frames_takes_the_whole_proof(doubt: dict[str, Any]) -> None:
    flight = Flight()
    flight.run(2)
    flight.run(0.4, frames=False)
    flight.run(0.05, **doubt)
    after: dict[str, Any] = {"reset_counter": doubt.get("reset_counter", 0)}
    assert not flight.run(0.95, **after)
    assert flight.run(0.3, **after)


def test_localisation_that_is_restarted_in_a_pause_takes_the_whole_proof() -> None:
    """Its poses are unrelated to those before, however short the pause was."""
    flight = Flight()
    flight.run(2)
    flight.run(0.4, frames=False)
    assert flight.gate.why_not == "no frames"
    flight.gate.restart()
    assert not flight.run(0.95)
    assert flight.run(0.3)
    assert flight.sent[-1][1].reset_counter == 1


def test_another_pause_while_proving_is_proven_too() -> None:
    flight = Flight()
    flight.run(2)
    flight.run(0.4, frames=False)
    flight.run(0.2)
    flight.run(0.4, frames=False)
    assert not flight.run(0.9)
    assert flight.run(0.2)


def rolled_over(t_ns: int) -> Pose:
    return Pose(rotation_from_quaternion(quaternion_from_euler(np.pi, 0.0, 0.7)), np.zeros(3))


def test_without_an_attitude_nothing_is_sent() -> None:
    flight = Flight()
    flight.has_attitude = False
    assert not flight.run(3)
    assert flight.gate.why_not == "no autopilot attitude"
    assert not flight.run(3, world_from_body=rolled_over(0))


@pytest.mark.parametrize("use", [(), ("imu", "position", "satellites", "range", "height")])
def test_without_belief_in_the_attitude_nothing_is_sent(use: tuple[Measurement, ...]) -> None:
    flight = Flight()
    flight.gate = PoseGate(FeedbackConfig(mode="odometry"), use=use)
    assert not flight.run(3)
    assert flight.gate.why_not == "attitude is not believed"
    flight.gate = PoseGate(FeedbackConfig(mode="odometry"), use=["attitude"])
    assert flight.run(3)


@pytest.mark.parametrize(("doubt", "proof_s"), [({}, 0.3), ({"quality": 5}, 1.0)])
def test_poses_go_on_soon_after_the_link_was_cut(doubt: dict[str, Any], proof_s: float) -> None:
    """What could not be checked for a while was tracked all the time; else the proof is whole."""
    flight = Flight()
    flight.run(2)
    flight.has_attitude = False
    flight.run(5)
    assert flight.gate.why_not == "no autopilot attitude"
    flight.run(0.1, **doubt)
    flight.has_attitude = True
    assert not flight.run(proof_s - 0.05)
    assert flight.run(0.2)
    assert {pose.reset_counter for _, pose in flight.sent} == {0}


def test_poses_stop_without_attitude() -> None:
    """And none is predicted unchecked: attitude is extrapolated by at most 120 ms."""
    flight = Flight()
    flight.run(2)
    flight.has_attitude, silent_ns = False, flight.now_ns
    flight.run(1, world_from_body=rolled_over(0))
    assert max(pose.t_ns for _, pose in flight.sent) <= silent_ns + 120 * MS
    assert not [at for at, _ in flight.sent if at > silent_ns + 300 * MS]
    assert not flight.gate.sending and flight.gate.why_not == "no autopilot attitude"
    flight.has_attitude = True
    assert not flight.run(0.3)
    assert flight.run(0.2)


def test_attitudes_are_not_interpolated_over_gaps() -> None:
    flight = Flight()
    flight.run(2)
    flight.has_attitude = False
    lost_ns = flight.now_ns
    flight.run(0.45)
    flight.has_attitude = True
    flight.run(0.1)
    between = [p for _, p in flight.sent if lost_ns + 120 * MS < p.t_ns < lost_ns + 330 * MS]
    assert not between


@pytest.mark.parametrize("late_ms", [20, 60])
def test_attitudes_may_arrive_after_the_frame(late_ms: int) -> None:
    flight = Flight()
    flight.delay_ns = late_ms * MS
    flight.run(2)
    assert len(flight.run(2)) >= 59


@pytest.mark.parametrize(
    "quaternion", [[math.nan] * 4, [0.0] * 4, [math.inf, 0.0, 0.0, 0.0], [1e-3, 0.0, 0.0, 0.0]]
)
def test_invalid_attitude_is_ignored(quaternion: list[float]) -> None:
    flight = Flight()
    flight.has_attitude = False
    for _ in range(150):
        flight.gate.take_attitude(AttitudeSample(flight.now_ns, np.array(quaternion)))
        assert not flight.run(0.02)
    assert flight.gate.why_not == "no autopilot attitude"


def test_invalid_rates_are_ignored() -> None:
    flight = Flight()
    flight.has_attitude = False
    for _ in range(150):
        rates = np.array([math.nan, 0.0, 0.0])
        flight.gate.take_attitude(AttitudeSample(flight.now_ns, ATTITUDE, rates))
        flight.run(0.02)
    assert flight.sent
    assert all(np.isfinite(pose.world_from_body.rotation).all() for _, pose in flight.sent)


def test_poses_start_at_the_height_of_the_autopilot() -> None:
    gate = PoseGate(FeedbackConfig(mode="odometry"), start_down_m=lambda _t_ns: start_m)
    flight = Flight()
    flight.gate, start_m = gate, None
    assert not flight.run(2) and gate.why_not == "no autopilot height"
    start_m = -7.5
    first = flight.run(0.2)[0]
    start_m = 40.0
    assert {p.world_from_body.translation[2] for p in [first, *flight.run(2)]} == {-7.5}
    lower = Pose(rotation_from_quaternion(ATTITUDE), np.array([0.0, 0.0, -2.0]))
    assert flight.run(0.2, world_from_body=lower)[-1].world_from_body.translation[2] == -6.5
    flight.run(0.1, reset_counter=1)
    assert flight.run(2, reset_counter=1)[-1].world_from_body.translation[2] == 40.0


def test_pause_without_discontinuity_keeps_the_height_offset() -> None:
    start_m = -7.5
    flight = Flight()
    flight.gate = PoseGate(FeedbackConfig(mode="odometry"), start_down_m=lambda _t_ns: start_m)
    flight.run(2)
    start_m = 40.0
    flight.run(1, frames=False)
    poses = flight.run(2)
    assert {p.world_from_body.translation[2] for p in poses} == {-7.5}
    assert {p.reset_counter for p in poses} == {0}


def test_start_condition_withholds_the_first_pose_only() -> None:
    against = "not yet"
    flight = Flight()
    flight.gate = PoseGate(FeedbackConfig(mode="odometry"), may_start=lambda _now_ns: against)
    assert not flight.run(2) and flight.gate.why_not == "not yet"
    against = ""
    assert flight.run(0.1)
    against = "not yet"
    assert len(flight.run(1)) >= 29


def test_reboot_of_the_autopilot_resets_the_counter() -> None:
    flight = Flight()
    flight.run(2)
    flight.run(2, reset_counter=1)
    flight.gate.autopilot_booted(None)
    assert not flight.gate.sending and flight.gate.why_not == "autopilot rebooted"
    assert not flight.run(0.9, reset_counter=1)
    assert {p.reset_counter for p in flight.run(1, reset_counter=1)} == {0}
    flight.gate.autopilot_booted(254)
    assert {p.reset_counter for p in flight.run(2, reset_counter=1)} == {255}
    flight.run(0.1, reset_counter=2)
    assert {p.reset_counter for p in flight.run(2, reset_counter=2)} == {0}


def test_missing_scale_is_reported() -> None:
    flight = Flight()
    assert not flight.run(2, world_from_body=None, quality=-1)
    assert flight.gate.why_not == "no metric scale"


def test_unknown_heading_variance_is_sent_as_unknown() -> None:
    pose = PoseToSend(
        10**12, Pose.identity(), np.zeros(3), 0.1, math.inf, 0.01, math.inf, 80, 0
    )  # fmt: skip
    message = odometry_message(pose, "ardupilot")
    assert message.pose_covariance[18] == pytest.approx(1e-4)
    assert math.isnan(message.pose_covariance[20])
    assert math.isnan(message.velocity_covariance[0])


def test_heading_variance_is_sent() -> None:
    flight = Flight()
    assert {pose.sigma_yaw_rad for pose in flight.run(2)} == {0.05}


def test_odometry_message() -> None:
    pose = PoseToSend(
        1_234_567_890_123, Pose(rotation_from_quaternion(ATTITUDE), np.array([1.0, 2.0, -3.0])),
        np.array([1.0, 0.5, -0.2]), 0.1, 0.2, 0.01, 0.05, 80, 7,
    )  # fmt: skip
    message = odometry_message(pose, "ardupilot")
    assert (message.frame_id, message.child_frame_id) == (20, 12), "LOCAL_FRD"
    to_px4 = odometry_message(pose, "px4")
    assert (to_px4.frame_id, to_px4.child_frame_id) == (1, 12), "LOCAL_NED: it would turn the other"
    assert (to_px4.x, to_px4.y, to_px4.z) == (message.x, message.y, message.z) == (1.0, 2.0, -3.0)
    assert (message.time_usec, message.reset_counter, message.quality) == (1_234_567_890, 7, 80)
    assert np.allclose(message.q, ATTITUDE)
    body = pose.world_from_body.rotation.T @ pose.velocity_world_m_s
    assert np.allclose([message.vx, message.vy, message.vz], body)
    diagonal = [message.pose_covariance[i] for i in (0, 6, 11, 15, 18, 20)]
    assert np.allclose(diagonal, [0.01] * 3 + [1e-4] * 2 + [2.5e-3])
    assert sum(message.pose_covariance) == pytest.approx(sum(diagonal)), "nothing beside it"
    position, speed = vision_messages(pose)
    assert np.allclose(position.covariance, message.pose_covariance)
    assert np.allclose([position.roll, position.pitch, position.yaw], [0.1, -0.2, 0.7])
    assert (speed.x, speed.y, speed.z) == (1.0, 0.5, -0.2)


def test_the_velocity_alone_says_nothing_of_the_place() -> None:
    pose = PoseToSend(
        10**12, Pose(rotation_from_quaternion(ATTITUDE), np.array([1.0, 2.0, -3.0])),
        np.array([1.0, 0.5, -0.2]), 0.1, 0.2, 0.01, 0.05, 80, 7,
    )  # fmt: skip
    whole, (message,) = odometry_message(pose, "px4"), pose_messages(pose, "velocity", "px4")
    places = message.x, message.y, message.z, *message.q, *message.pose_covariance
    assert all(math.isnan(each) for each in places)
    for name in ("vx", "vy", "vz", "time_usec", "child_frame_id", "quality", "reset_counter"):
        assert getattr(message, name) == getattr(whole, name)
    assert message.velocity_covariance[0] == pytest.approx(0.04)
    (message,) = pose_messages(pose, "velocity", "ardupilot")
    assert message.get_type() == "VISION_SPEED_ESTIMATE"
    assert (message.x, message.y, message.z) == (1.0, 0.5, -0.2)


BLIND: dict[str, Any] = {"state": TrackState.DEAD_RECKONING, "quality": 1, "inertial": True}


def test_inertial_dead_reckoning_bridges_what_is_not_tracked() -> None:
    flight = Flight()
    flight.run(2)
    assert flight.state() is Sending.SENDING
    poses = flight.run(3, **BLIND)
    assert flight.state() is Sending.BRIDGING
    assert len(poses) > 3 * 29
    assert min(pose.quality for pose in poses) == 1
    # tracked again: no proof is needed, as nothing has jumped
    assert len(flight.run(1)) > 29
    assert flight.state() is Sending.SENDING


def test_poses_of_accelerometers_alone_weigh_as_one() -> None:
    """Their error is one and the same; told as independent ones, they led PX4's attitude astray."""
    flight = Flight()
    flight.run(2)
    aided = flight.run(1, **BLIND, unaided_s=0.3)
    assert max(pose.sigma_position_m for pose in aided) < 0.15
    assert not any(pose.unaided for pose in aided)
    alone = flight.run(2, **BLIND, unaided_s=0.5)
    assert sum(1.0 / pose.sigma_position_m**2 for pose in alone) < 7 / 0.1**2  # 80 poses
    assert alone[-1].sigma_velocity_m_s > 8 * 0.2
    message = odometry_message(alone[-1], "px4")
    assert message.pose_covariance[0] == pytest.approx(alone[-1].sigma_position_m ** 2)
    (position,) = pose_messages(alone[-1], "odometry", "ardupilot")
    assert position.get_type() == "VISION_POSITION_ESTIMATE"
    assert not pose_messages(alone[-1], "velocity", "ardupilot")
    assert flight.run(0.1)[-1].sigma_position_m < 0.15


def test_a_bridge_ends_where_its_uncertainty_does() -> None:
    flight = Flight(max_sigma_m=1.0)
    flight.run(2)
    assert flight.run(0.5, **BLIND, sigma_position_m=0.99)
    assert len(flight.run(1, **BLIND, sigma_position_m=1.01)) <= 8  # max_gap_ms predicted
    assert (flight.gate.state, flight.gate.why_not) == (Sending.OFF, "lost")
    assert not flight.run(2, **BLIND)  # nothing begins on a bridge
    assert not flight.run(0.3)  # tracked where dead reckoning has foretold
    assert flight.state() is Sending.PROVING
    assert flight.run(0.2)


@pytest.mark.parametrize(("late_s", "resumes"), [(0.5, True), (3.5, False)])
def test_a_bridge_goes_on_after_frames_that_came_too_late(late_s: float, resumes: bool) -> None:
    flight = Flight()
    flight.run(2)
    flight.run(1, **BLIND)
    flight.run(late_s, frames=False)
    assert (flight.gate.state, flight.gate.why_not) == (Sending.OFF, "no frames")
    assert not flight.run(min(late_s, 1.0) - 0.1, **BLIND)
    assert bool(flight.run(0.5, **BLIND)) is resumes
    assert flight.state() is (Sending.BRIDGING if resumes else Sending.OFF)


def test_a_velocity_that_is_held_is_less_certain_the_longer_it_is() -> None:
    flight = Flight(period_ms=200)
    flight.run(3)
    poses = flight.run(1)
    since_s = [(p.t_ns + LATENCY_NS) % (200 * MS) * 1e-9 for p in poses]
    assert max(since_s) > 0.1
    for pose, held_s in zip(poses, since_s, strict=True):
        assert pose.predicted == (held_s > 0.0)
        may_come_m_s = SIGMA_JERK_M_S3 * held_s**2 / 2.0
        assert pose.sigma_velocity_m_s == pytest.approx(np.hypot(0.2, may_come_m_s))
        grown_m = held_s * np.hypot(0.2, may_come_m_s / 2.0)
        assert pose.sigma_position_m == pytest.approx(np.hypot(0.1, grown_m))


def test_a_pose_with_an_old_velocity_is_not_sent() -> None:
    """One of unknown certainty is not known: an autopilot would take it all the same."""
    flight = Flight()
    flight.run(2)
    assert not [p for p in flight.run(1, sigma_velocity_m_s=float("inf")) if not p.predicted]
    assert flight.state() is Sending.OFF


def test_none_is_predicted_beyond_the_limit() -> None:
    """Which is of the place apart from the scale."""
    flight = Flight(max_sigma_m=1.0)
    flight.run(2)
    scaled: dict[str, Any] = {
        "sigma_position_m": 1.05,
        "sigma_by_scale_m": 0.4,
        "sigma_velocity_m_s": 1.0,
    }
    assert any(pose.predicted for pose in flight.run(0.5, **scaled))
    flight.run(0.1, sigma_position_m=0.9999, sigma_velocity_m_s=1.0)
    poses = flight.run(0.5, sigma_position_m=0.9999, sigma_velocity_m_s=1.0)
    assert len(poses) == 10
    assert not any(pose.predicted for pose in poses)
    assert flight.state() is Sending.SENDING


def test_dead_reckoning_by_a_held_velocity_is_not_sent() -> None:
    flight = Flight()
    flight.run(2)
    flight.run(1, **(BLIND | {"inertial": False}))
    assert (flight.gate.state, flight.gate.why_not) == (Sending.OFF, "lost")


def test_a_map_begun_anew_is_without_scale_not_lost() -> None:
    flight = Flight()
    flight.run(2)
    assert not [p for p in flight.run(2, world_from_body=None) if not p.predicted]
    assert (flight.gate.state, flight.gate.why_not) == (Sending.OFF, "no metric scale")


def test_a_bridge_is_level_by_the_autopilot_too() -> None:
    flight = Flight()
    flight.run(2)
    tilted = Pose(rotation_from_quaternion(quaternion_from_euler(0.4, -0.2, 0.7)), np.zeros(3))
    flight.run(1, **BLIND, world_from_body=tilted)
    assert flight.state() is Sending.OFF


@pytest.mark.parametrize(("off_m", "proof_s", "down_m"), [(3.0, 0.3, -3.0), (5.0, 1.0, 40.0)])
@pytest.mark.parametrize("uncertain_s", [0.0, 2.0])
def test_a_reset_that_ends_dead_reckoning_is_proven_by_how_far_it_leads(
    off_m: float, proof_s: float, down_m: float, uncertain_s: float
) -> None:
    """To where it may have been off by is briefly; then heights are those of before, too."""
    start_down_m = -3.0
    flight = Flight()
    flight.gate = PoseGate(FeedbackConfig(), start_down_m=lambda _t_ns: start_down_m)
    flight.run(2)
    flight.run(1, **BLIND, sigma_position_m=0.9)
    start_down_m = 40.0
    flight.run(uncertain_s, **BLIND, sigma_position_m=1.1)
    at = np.array([1.0 + flight.now_ns * 1e-9 * 2, 2.0 + off_m, -3.0])
    there = Pose(rotation_from_quaternion(ATTITUDE), at)
    seen: dict[str, Any] = {"reset_counter": 1, "world_from_body": there}
    assert not [pose for pose in flight.run(proof_s, **seen) if pose.reset_counter]
    assert flight.state() is Sending.PROVING
    first = flight.run(0.2, **seen)[0]
    assert first.world_from_body.translation[2] == pytest.approx(down_m)


def test_a_stand_is_sent_and_a_lift_off_bridged() -> None:
    """Before there is any map; proof is the same."""
    flight = Flight()
    stand: dict[str, Any] = {"state": TrackState.STANDING, "quality": 100, "sigma_position_m": 0.02}
    assert not flight.run(0.9, **stand)
    assert flight.run(1.0, **stand)
    assert flight.state() is Sending.SENDING
    assert len(flight.run(2.0, **BLIND)) > 50
    assert flight.state() is Sending.BRIDGING
    assert len(flight.run(1.0)) > 25
    assert flight.state() is Sending.SENDING
    assert {pose.reset_counter for _, pose in flight.sent} == {0}
