"""Rotation regression separates late and jittery telemetry from a gimbal."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from companion.estimation.attitude.attitude_following import RotationAgreement, RotationComparison
from companion.geometry.transforms import (
    Array,
    angle_between,
    quaternion_from_euler,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
    vector_from_rotation,
)
from companion.telemetry import AttitudeSample
from tests.support.flights.scene import DOWN_LOOKING

T0_NS = 10**12
SECONDS = 9.0
Stamp = Callable[[float, np.random.Generator], float]
"""What a stamp in seconds becomes."""


def euler(t_s: float) -> Array:
    """Roll, pitch and yaw of a copter in wind, rad."""
    return np.array([
        0.10 * np.sin(2.1 * t_s) + 0.03 * np.sin(9.0 * t_s + 1),
        0.08 * np.sin(1.7 * t_s + 2) + 0.03 * np.sin(7.0 * t_s),
        0.5 * np.sin(0.6 * t_s),
    ])  # fmt: skip


def body(t_s: float) -> Array:
    return rotation_from_quaternion(quaternion_from_euler(*euler(t_s)))


def levelled(t_s: float) -> Array:
    """Roll and pitch stabilised, heading followed."""
    return rotation_from_quaternion(quaternion_from_euler(0.0, 0.0, euler(t_s)[2]))


def without_roll(t_s: float) -> Array:
    return rotation_from_quaternion(quaternion_from_euler(0.0, *euler(t_s)[1:]))


def swept(t_s: float) -> Array:
    """Levelled, and panned and tilted by the pilot."""
    return rotation_from_quaternion(
        quaternion_from_euler(0.0, 0.3 * np.sin(0.8 * t_s), 0.6 * np.sin(0.5 * t_s + 1))
    )


def fixed(t_s: float) -> Array:
    return np.eye(3)


def result(
    stamp: Stamp = lambda t_s, rng: t_s,
    camera_on: Callable[[float], Array] = body,
    body_as: Callable[[float], Array] = body,
    mount: Array = DOWN_LOOKING,
    rate_hz: float = 20.0,
    turns_as: Callable[[float], Array] | None = None,
) -> RotationAgreement:
    """Agreement at the end of a flight with these stamps.

    The autopilot tells rates of a body that really turns as `turns_as`; none without.
    """
    rng = np.random.default_rng(3)
    test = RotationComparison()
    heading = rotation_from_vector(np.array([0.0, 0.0, 1.1]))
    for k in range(int((SECONDS + 1.0) * 50)):
        noise = rotation_from_vector(rng.normal(scale=0.0015, size=3))
        attitude = quaternion_from_rotation(body_as(k / 50) @ noise)
        rates = None
        if turns_as is not None:
            step = turns_as(k / 50 - 0.01).T @ turns_as(k / 50 + 0.01)
            rates = vector_from_rotation(step) / 0.02 + rng.normal(scale=0.02, size=3)
        test.add(AttitudeSample(T0_NS + int(k / 50 * 1e9), attitude, rates))
    for k in range(int(SECONDS * rate_hz)):
        t_s = k / rate_hz
        noise = rotation_from_vector(rng.normal(scale=0.001, size=3))
        said_ns = T0_NS + int(stamp(t_s, rng) * 1e9)
        test.take(said_ns, heading @ camera_on(t_s) @ mount @ noise)
    found = test.result(DOWN_LOOKING)
    assert found is not None
    return found


def late(delay_s: float, jitter_s: float, kind: str) -> Stamp:
    def stamp(t_s: float, rng: np.random.Generator) -> float:
        at_s = t_s + delay_s
        if kind == "normal":
            return at_s + float(rng.normal(scale=jitter_s))
        if kind == "uniform":
            return at_s + float(rng.uniform(-jitter_s, jitter_s))
        return float(np.ceil(at_s / max(jitter_s, 1e-3)) * max(jitter_s, 1e-3))  # when polled

    return stamp


@pytest.mark.parametrize("kind", ["normal", "uniform", "quantised"])
@pytest.mark.parametrize("jitter_s", [0.0, 0.015, 0.03])
@pytest.mark.parametrize("delay_s", [-0.15, 0.0, 0.04, 0.09, 0.15])
def test_late_and_jittery_camera_is_body_fixed(delay_s: float, jitter_s: float, kind: str) -> None:
    found = result(late(delay_s, jitter_s, kind))
    assert not found.stabilised
    assert found.body_fixed
    assert abs(found.offset_s + delay_s) < 0.05


@pytest.mark.parametrize("camera_on", [levelled, without_roll, fixed, swept])
@pytest.mark.parametrize("jitter_s", [0.0, 0.03])
@pytest.mark.parametrize("turns_as", [None, body], ids=["without rates", "with rates"])
def test_gimbal_is_detected_as_stabilised(
    camera_on: Callable[[float], Array], jitter_s: float, turns_as: Callable[[float], Array] | None
) -> None:
    found = result(late(0.05, jitter_s, "uniform"), camera_on, turns_as=turns_as)
    assert found.stabilised
    assert not found.body_fixed


def test_panned_camera_on_a_still_body_is_not_body_fixed() -> None:
    found = result(camera_on=swept, body_as=fixed)
    assert not found.stabilised
    assert not found.body_fixed
    assert found.rotates_independently


def test_heading_reset_is_no_gimbal() -> None:
    """An autopilot rotates its own estimate by 25 degrees when its compass is corrected."""

    def body_as(t_s: float) -> Array:
        jump = rotation_from_vector(np.array([0.0, 0.0, np.radians(25.0) * (t_s > 4.5)]))
        return jump @ rotation_from_quaternion(
            quaternion_from_euler(*(euler(t_s) * [1.0, 1.0, 0.0]))
        )

    def camera_on(t_s: float) -> Array:
        return rotation_from_quaternion(quaternion_from_euler(*(euler(t_s) * [1.0, 1.0, 0.0])))

    found = result(camera_on=camera_on, body_as=body_as)
    assert not found.stabilised
    assert found.body_fixed


def test_a_heading_that_is_corrected_for_seconds_is_no_gimbal() -> None:
    """PX4 turns its heading by some degrees a second after a take-off; its rates do not show it."""

    def leaning(t_s: float) -> Array:
        return rotation_from_quaternion(
            quaternion_from_euler(*(euler(t_s) * [0.5, 0.5, 0.0] + [0.25, 0.0, 0.0]))
        )

    def corrected(t_s: float) -> Array:
        heading_rad = np.radians(9.0) * min(max(t_s - 1.0, 0.0), 5.0)
        return rotation_from_vector(np.array([0.0, 0.0, heading_rad])) @ leaning(t_s)

    assert result(camera_on=leaning, body_as=corrected).stabilised, "by the attitude alone"
    found = result(camera_on=leaning, body_as=corrected, turns_as=leaning)
    assert not found.stabilised and not found.rotates_independently
    assert found.body_fixed


def test_without_rotation_nothing_is_concluded() -> None:
    found = result(camera_on=fixed, body_as=fixed)
    assert not found.stabilised
    assert not found.body_fixed
    assert not found.rotates_independently


def test_wrong_mount_is_estimated() -> None:
    """A camera mounted the other way round."""
    turn = rotation_from_vector(np.radians([0.0, 0.0, 90.0]))
    found = result(mount=turn @ DOWN_LOOKING)
    assert not found.body_fixed
    assert found.mount_correction is not None
    assert np.degrees(angle_between(found.mount_correction, turn)) < 5.0
    assert result(camera_on=levelled).mount_correction is None


def test_mount_off_by_15_degrees_is_body_fixed() -> None:
    turn = rotation_from_vector(np.radians([9.0, 9.0, 7.0]))
    found = result(mount=turn @ DOWN_LOOKING)
    assert found.body_fixed
    assert not found.stabilised


def test_too_little_data_gives_none() -> None:
    assert RotationComparison().result(DOWN_LOOKING) is None
