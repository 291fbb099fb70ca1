"""Optical flow that a simulated autopilot receives, from the first frames on and without poses."""

from __future__ import annotations

import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from companion.geometry.transforms import Array, vector_from_rotation
from tests.support.autopilot.fake_autopilot import Received
from tests.support.cameras.http_camera import world_from_body
from tests.support.processes.flying import Flying

STEP_NS = 20_000_000
MOST_LATE_NS = 200_000_000
"""The camera states no times: a picture may be taken for one that is so much newer."""


def true_rates(from_ns: int, to_ns: int) -> Array:
    """Mean rates of the body, rad/s."""
    before, after = world_from_body(from_ns), world_from_body(to_ns)
    turn = vector_from_rotation(before.rotation.T @ after.rotation)
    return turn / (1e-9 * (to_ns - from_ns))


def true_flow(at_ns: int) -> Array:
    """Translational flow of a sensor that looks down, rad/s."""
    here = world_from_body(at_ns)
    moved = world_from_body(at_ns + STEP_NS).translation - here.translation
    forward, right, _ = here.rotation.T @ moved / (1e-9 * STEP_NS)
    seen: Array = np.array([-right, forward]) * here.rotation[2, 2] / -here.translation[2]
    return seen


def derotated(kind: str, received: list[Received]) -> tuple[Array, list[int]]:
    """Flow (N, 2) as the firmware finds it, and when it was by CLOCK_MONOTONIC."""
    epoch_ns = time.time_ns() - time.monotonic_ns()
    flows, when_ns = [], []
    for last, got in pairwise(received):
        message = got.message
        if message.quality == 0:
            continue
        if kind == "OPTICAL_FLOW":
            seen = np.array([message.flow_rate_x, message.flow_rate_y])
            flows.append(seen - true_rates(last.monotonic_ns, got.monotonic_ns)[:2])
        else:
            seen = np.array([message.integrated_x, message.integrated_y])
            gyro = np.array([message.integrated_xgyro, message.integrated_ygyro])
            flows.append((seen - gyro) / (1e-6 * message.integration_time_us))
        when_ns.append(message.time_usec * 1000 - epoch_ns)
    return np.array(flows), when_ns


@pytest.mark.parametrize("kind", ["OPTICAL_FLOW", "OPTICAL_FLOW_RAD"])
def test_the_autopilot_gets_the_flow(tmp_path: Path, kind: str) -> None:
    settings = ("feedback.mode=off", f"feedback.flow={kind.lower()}", "recorder.enabled=false")
    with Flying(tmp_path, *settings) as flying:
        flying.autopilot.arm()
        flying.autopilot.wait_for(kind, 60, 90, lambda got: got.message.quality > 0)
        health = flying.daemon.until(
            lambda health: health["flow"]["sending"] and health["flow"]["rate_hz"] > 5, "rate"
        )
        assert health["flow"]["message"] == kind.lower()
        found, when_ns = derotated(kind, flying.autopilot.of(kind))
        assert not flying.autopilot.of("ODOMETRY")
        flying.camera.covered = True
        flying.daemon.until(lambda health: health["flow"]["why_not"] != "", "it sees nothing")
        # what was sent before may still be on its way
        covered_ns = time.monotonic_ns() + 500_000_000
        time.sleep(1.5)
        dark = [each for each in flying.autopilot.of(kind) if each.monotonic_ns > covered_ns]
        flying.assert_stops()
    late_ns = range(0, MOST_LATE_NS, STEP_NS)
    wrong = np.array([
        min(float(np.linalg.norm(flow - true_flow(at_ns - late))) for late in late_ns)
        for flow, at_ns in zip(found, when_ns, strict=True)
    ])  # fmt: skip
    speed = float(np.median(np.linalg.norm(found, axis=1)))
    print(
        f"{np.median(wrong):.3f} rad/s off, 90 % within {np.quantile(wrong, 0.9):.3f}; {speed:.2f}"
    )
    assert speed > 0.15
    assert np.median(wrong) < 0.03
    assert np.quantile(wrong, 0.9) < 0.1
    assert {each.message.quality for each in dark} == ({0} if kind == "OPTICAL_FLOW" else set())
