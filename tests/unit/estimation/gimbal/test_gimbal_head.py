"""The head's attitude of what gimbal and autopilot tell, and the body's pose out of the head's."""

from __future__ import annotations

import numpy as np
import pytest

from companion.estimation.gimbal.gimbal_head import GIMBAL_HEARD, GIMBAL_SILENT, GimbalHead
from companion.geometry.gimbal import Gimbal
from companion.geometry.transforms import (
    Array,
    Pose,
    angle_between,
    quaternion_from_euler,
    quaternion_from_rotation,
    rotation_from_quaternion,
    yaw_rotation,
)
from companion.messages import Odometry, TrackState
from companion.telemetry import AttitudeSample, GimbalSample, PositionSample, PositionSource

MS = 1_000_000
PLACE = np.array([0.2, 0.0, 0.1])
GIMBAL = Gimbal((0.2, 0.0, 0.1), sigma_deg=1.0)


def body(t_ns: int) -> Array:
    """Leaning, and turning by a radian a second."""
    return rotation_from_quaternion(quaternion_from_euler(0.1, -0.2, 1.0 + 1e-9 * t_ns))


def attitude(t_ns: int) -> AttitudeSample:
    return AttitudeSample(t_ns, quaternion_from_rotation(body(t_ns)))


def odometry(t_ns: int, head: Pose | None) -> Odometry:
    return Odometry(
        1, t_ns, TrackState.TRACKING, 3, 90, head, np.zeros(3) if head else None, 0.1, 0.1, 0.02,
        0.03,
    )  # fmt: skip


LEVEL = quaternion_from_euler(0.0, -0.5, 0.3)


@pytest.mark.parametrize("late_ms", [0, 40])
def test_a_yaw_from_the_heading_takes_that_of_its_time(late_ms: int) -> None:
    head, found = GimbalHead(GIMBAL), []
    for t_ms in range(0, 400, 20):
        found += head.take(attitude(t_ms * MS), late_ms * MS)
        if t_ms % 50 == 10:
            found += head.take(GimbalSample((t_ms + 3) * MS, LEVEL), late_ms * MS)
    assert len(found) >= 3
    for sample in found:
        heading = 1.0 + 1e-9 * (sample.t_ns - late_ms * MS)
        expected = yaw_rotation(heading) @ rotation_from_quaternion(LEVEL)
        # the autopilot's attitude is interpolated as a rotation: heading of a leaning body
        assert angle_between(rotation_from_quaternion(sample.ned_from_body), expected) < 1e-3
    assert found[0].rates_body_rad_s is None
    rates = found[-1].rates_body_rad_s
    assert rates is not None and np.linalg.norm(rates) == pytest.approx(1.0, abs=0.02)


def test_a_yaw_from_north_waits_for_nothing() -> None:
    head = GimbalHead(GIMBAL)
    (sample,) = head.take(GimbalSample(5 * MS, LEVEL, yaw_from_north=True), 0)
    np.testing.assert_allclose(sample.ned_from_body, LEVEL, atol=1e-12)
    assert head.take(GimbalSample(9 * MS, LEVEL), 0) == []


def test_the_body_is_where_its_lever_has_it() -> None:
    head, t_ns = GimbalHead(GIMBAL), 200 * MS
    for t_ms in range(0, 400, 20):
        head.take(attitude(t_ms * MS), 0)
    truth = Pose(body(t_ns), np.array([3.0, -2.0, -10.0]))
    ned_from_head = yaw_rotation(2.0) @ rotation_from_quaternion(LEVEL)
    # the world of the map is turned against that of the autopilot
    turn = yaw_rotation(0.7)
    seen = Pose(turn @ ned_from_head, turn @ truth.translation + turn @ (truth.rotation @ PLACE))
    found = head.body_of(odometry(t_ns, seen), ned_from_head)
    assert found.world_from_body is not None and found.velocity_world_m_s is not None
    np.testing.assert_allclose(found.world_from_body.rotation, turn @ truth.rotation, atol=1e-9)
    np.testing.assert_allclose(
        found.world_from_body.translation, turn @ truth.translation, atol=1e-9
    )
    # the head does not move, so the body turns about it
    assert np.linalg.norm(found.velocity_world_m_s) == pytest.approx(
        float(np.linalg.norm(np.cross([0, 0, 1.0], truth.rotation @ PLACE))), rel=0.02
    )
    assert found.sigma_yaw_rad == pytest.approx(np.hypot(0.03, np.radians(1.0)))
    assert found.reset_counter == 3 and found.quality == 90


@pytest.mark.parametrize(("has_head", "has_body"), [(False, True), (True, False)])
def test_there_is_no_pose_of_the_body_without_either(has_head: bool, has_body: bool) -> None:
    head = GimbalHead(GIMBAL)
    if has_body:
        head.take(attitude(0), 0)
    given = odometry(10 * MS, Pose.identity())
    found = head.body_of(given, np.eye(3) if has_head else None)
    assert found.world_from_body is None and found.velocity_world_m_s is None
    assert found.quality == -1 and found.sigma_position_m == np.inf
    assert found.state is TrackState.LOST
    assert (found.seq, found.t_ns, found.reset_counter) == (1, 10 * MS, 3)


def test_a_position_is_that_of_the_head() -> None:
    head = GimbalHead(GIMBAL)
    sample = PositionSample(10 * MS, PositionSource.GPS, np.array([1.0, 2.0, 3.0]))
    assert head.of_head(sample) is sample
    head.take(attitude(10 * MS), 0)
    np.testing.assert_allclose(
        head.of_head(sample).position_ned_m, sample.position_ned_m + body(10 * MS) @ PLACE
    )


def test_silence_is_said_once_and_its_end() -> None:
    head = GimbalHead(GIMBAL)
    said = [w for k in range(40) for w in head.warnings(k * 50 * MS, known=not 10 <= k < 30)]
    assert [each.what for each in said] == [GIMBAL_SILENT, GIMBAL_HEARD]
    assert said[0].t_ns == 1000 * MS and "none was heard" in said[0].detail and said[1].good


def test_turns_that_the_rates_do_not_show_are_corrections() -> None:
    head, rates = GimbalHead(GIMBAL), np.array([0.0, 0.0, 1.0])
    for k in range(100):
        heading = 0.02 * k + np.radians(6.0) * min(max(0.0, (k - 40) / 20), 1.0)
        sample = AttitudeSample(
            20 * k * MS, quaternion_from_rotation(yaw_rotation(heading)), rates if k else None
        )
        head.take(sample, 0)
    assert head.corrected_rad == pytest.approx(np.radians(6.0), abs=1e-6)
