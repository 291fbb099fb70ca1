"""A camera that is covered, or gone: poses go on by accelerometers while they are certain."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from tests.support.processes.flying import Flying

pytestmark = pytest.mark.continues
TOLD = "position by dead reckoning"
MAX_SIGMA_M = 0.25
"""A quarter of what a pose may be wrong by: at the usual 1 m the last ones before poses end may be
wrong by more than that, and be honest."""


@pytest.fixture(scope="module")
def flying(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Flying]:
    limit = f"expert.feedback.max_sigma_m={MAX_SIGMA_M}"
    with Flying(tmp_path_factory.mktemp("covered"), limit, has_imu=True) as begun:
        begun.take_off()
        # the rates of the other messages are measured before the IMU is asked for
        begun.autopilot.wait_for("ODOMETRY", 600, 120)
        yield begun


@pytest.mark.parametrize("how", ["covered", "stalled"])
def test_poses_go_on_without_sight_for_two_seconds(flying: Flying, how: str) -> None:
    flying.until_sending()
    n_resets = flying.daemon.status()["feedback"]["n_resets"]
    covered_ns = time.monotonic_ns()
    setattr(flying.camera, how, True)
    flying.daemon.until(lambda health: health["feedback"]["bridging"], "it bridges")
    flying.until_told(TOLD, covered_ns)
    time.sleep(max(0.0, 2.0 - (time.monotonic_ns() - covered_ns) * 1e-9))
    setattr(flying.camera, how, False)
    seen_ns = time.monotonic_ns()
    flying.daemon.until(lambda health: health["tracker"] == "tracking", "it is found")
    flying.until_told("vision position on", seen_ns)
    flying.assert_went_on(covered_ns)
    assert flying.daemon.status()["feedback"]["n_resets"] == n_resets
    flying.assert_true_poses()


def test_they_end_when_they_are_uncertain(flying: Flying) -> None:
    flying.until_sending()
    covered_ns = time.monotonic_ns()
    flying.camera.covered = True
    flying.until_told("vision position lost", covered_ns)
    flying.daemon.until(lambda health: not health["feedback"]["sending"], "no poses")
    flying.camera.covered = False
    seen_ns = time.monotonic_ns()
    flying.until_told("vision position on", seen_ns)
    flying.assert_true_poses()
    unaided = flying.autopilot.of("VISION_POSITION_ESTIMATE")
    assert unaided, "no velocity that the autopilot knows as well by itself"
    assert max(each.message.covariance[0] for each in unaided) > 1.0**2, "many that err alike"


def test_it_ends_well(flying: Flying) -> None:
    flying.assert_stops()
    assert not flying.daemon.said("Traceback")
