"""A rangefinder looks down from the body: it aids by the tilt of that, not of a gimbal's head."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext

import numpy as np
import pytest

from companion.config_file import load_config
from companion.estimation.localisation import LocalisationStage
from companion.geometry.transforms import quaternion_from_euler, rotation_from_quaternion
from companion.messages import Frame, Odometry
from companion.telemetry import (
    ArmedSample,
    AttitudeSample,
    GimbalSample,
    ImuSample,
    RangeSample,
    Telemetry,
)
from tests.support.flights.gimbal_flight import CAMERA, DOWN_RAD
from tests.support.flights.rendered_flight import START_NS

STEP_NS, STANDS_STEPS, FLIES_STEPS = 10_000_000, 1100, 500
LEGS_M, CLIMB_M_S2, TOO_MUCH_M_S2 = 0.2, 0.5, 0.15
LEANS_RAD = np.radians(20.0)
G_NED = np.array([0.0, 0.0, 9.80665])


def risen_m(step: int) -> float:
    return 0.5 * CLIMB_M_S2 * (1e-9 * STEP_NS * max(step - STANDS_STEPS, 0)) ** 2


def samples(step: int) -> Iterator[Telemetry]:
    """Of a vehicle that climbs straight up and leans; its accelerometers measure too much."""
    t_ns, flies = START_NS + step * STEP_NS, step >= STANDS_STEPS
    lean_rad = min(max(step - STANDS_STEPS, 0) / 50, 1.0) * LEANS_RAD
    body = quaternion_from_euler(0.0, lean_rad, 0.0)
    rate = LEANS_RAD / 0.5 if 0 < step - STANDS_STEPS < 50 else 0.0
    up = np.array([0.0, 0.0, -(CLIMB_M_S2 + TOO_MUCH_M_S2) if flies else 0.0])
    force = rotation_from_quaternion(body).T @ (up - G_NED)
    noise = np.random.default_rng(step).normal(0.0, 0.02, 3)
    yield ImuSample(t_ns, np.array([0.0, rate, 0.0]), force + noise)
    yield AttitudeSample(t_ns, body)
    if step % 5 == 0:
        yield GimbalSample(t_ns, quaternion_from_euler(0.0, float(DOWN_RAD), 0.0))
        yield ArmedSample(t_ns, flies)
    if step % 10 == 0:
        yield RangeSample(t_ns, (LEGS_M + risen_m(step)) / float(np.cos(lean_rad)))


@pytest.mark.parametrize("has_ranges", [True, False])
def test_a_range_aids_by_the_tilt_of_the_body(has_ranges: bool) -> None:
    stage = LocalisationStage(load_config(None, []), CAMERA, lambda _: nullcontext())
    ground = np.random.default_rng(1).integers(0, 255, (CAMERA.height, CAMERA.width))
    off_m = []
    for step in range(STANDS_STEPS + FLIES_STEPS):
        for sample in samples(step):
            if has_ranges or not isinstance(sample, RangeSample):
                stage.step(sample)
        if step % 5:
            continue
        grey = (ground if step < STANDS_STEPS else np.full_like(ground, 252)).astype(np.uint8)
        frame = Frame(step // 5, START_NS + step * STEP_NS, grey, np.repeat(grey[..., None], 3, 2))
        for out in stage.step(frame):
            if isinstance(out, Odometry) and out.world_from_body is not None:
                down_m = float(out.world_from_body.translation[2])
                off_m.append(-down_m - risen_m(step))
    assert len(off_m) > FLIES_STEPS / 5 - 10
    by_climb_m = off_m[-1] - off_m[-int(FLIES_STEPS / 5)]
    assert abs(by_climb_m) < 0.6 if has_ranges else by_climb_m > 1.0
