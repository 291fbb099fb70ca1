"""From power-on to a second arming without satellites: poses are there before, and never stop."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest

from companion.geometry.transforms import Pose
from drivers.recording.flights_folder import UNARMED
from tests.support.cameras.http_camera import world_from_body
from tests.support.processes.flying import Flying

pytestmark = pytest.mark.continues
SWAYS_M = 0.002
"""Without it camera and IMU, which have no noise, would be a frozen and a stuck one."""


def stands(monotonic_ns: int) -> Pose:
    sway_m = SWAYS_M * np.sin(2.0 * np.pi * monotonic_ns * 1e-9 * np.array([1.0, 0.7, 0.9]))
    height = np.array([0.0, 0.0, world_from_body(0).translation[2]])
    return Pose(world_from_body(0).rotation, sway_m + height)


@pytest.fixture(scope="module")
def flying(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Flying]:
    use = 'telemetry.use=["attitude", "imu", "height"]'
    with Flying(tmp_path_factory.mktemp("stands"), use, path=stands, has_imu=True) as begun:
        yield begun


def test_poses_are_sent_before_arming(flying: Flying) -> None:
    flying.until_sending()
    flying.daemon.until(
        lambda health: (health["tracker"], health["flight"]) == ("standing", ""), "it stands"
    )
    (folder,) = flying.daemon.flown()
    assert (folder / UNARMED).exists()
    flying.assert_true_poses()


def test_they_go_on_through_arming_disarming_and_arming_again(flying: Flying) -> None:
    began_ns = time.monotonic_ns()
    for armed in (True, False, True):
        told_ns = time.monotonic_ns()
        flying.autopilot.arm(armed)
        flying.daemon.line(": armed" if armed else ": disarmed", after_ns=told_ns)
        time.sleep(3.0)
    flying.assert_went_on(began_ns)
    assert len(set(flying.poses.resets.tolist())) == 1
    flying.assert_true_poses()
    (folder,) = flying.daemon.flown()
    flying.daemon.until(lambda health: health["flight"] == folder.name, "its flight")
    assert not (folder / UNARMED).exists()
    flying.daemon.line("results so far", after_ns=began_ns)
    assert (folder / "report.html").exists()


def test_what_was_never_armed_leaves_nothing(flying: Flying) -> None:
    flown = flying.daemon.flown()
    told_ns = time.monotonic_ns()
    flying.autopilot.disarm()
    flying.daemon.line(": disarmed", after_ns=told_ns)
    flying.start_again()
    flying.until_sending()
    assert len(flying.daemon.flown()) == 2
    flying.assert_stops()
    assert flying.daemon.flown() == flown
    assert not flying.daemon.said("Traceback")
