"""Faults of the camera in flight: no bad pose is sent, a warning, and recovery."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import pytest

from tests.support.processes.flying import Flying

pytestmark = pytest.mark.continues


@pytest.fixture(scope="module")
def flying(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Flying]:
    folder = tmp_path_factory.mktemp("camera")
    # of ten pictures a second one that is lost leaves a gap that no prediction bridges
    with Flying(folder, "recorder.enabled=false", camera_on=False, camera_hz=15) as begun:
        yield begun


@pytest.fixture(autouse=True)
def all_well_again(flying: Flying) -> Iterator[None]:
    yield
    flying.camera.heal()


def test_missing_at_the_start_and_coming_later(flying: Flying) -> None:
    flying.daemon.line("the camera is not there")
    assert flying.until_source("camera", "missing")["n"] == 0
    flying.until_source("autopilot", "running")
    flying.daemon.until(lambda health: health["tracker"] == "waiting for the camera", "it waits")
    flying.autopilot.arm()
    assert not flying.daemon.flown()
    plugged_ns = time.monotonic_ns()
    flying.camera.on = True
    flying.until_source("camera", "running")
    flying.assert_soon(plugged_ns, time.monotonic_ns())
    flying.until_sending()
    flying.assert_true_poses()


def unplug(flying: Flying, is_so: bool) -> None:
    flying.camera.on = not is_so


def stall(flying: Flying, is_so: bool) -> None:
    flying.camera.stalled = is_so


def freeze(flying: Flying, is_so: bool) -> None:
    flying.camera.frozen = is_so


def resize(flying: Flying, is_so: bool) -> None:
    flying.camera.size = (256, 192) if is_so else (320, 240)


@pytest.mark.parametrize(
    ("fault", "states", "named"),
    [
        (unplug, ("missing",), "the camera has gone"),
        (stall, ("silent", "missing", "opening"), "warning: the camera "),
        (freeze, ("frozen",), "the camera is frozen"),
        (resize, ("silent",), "pictures of another size are refused"),
    ],
)
def test_invalid_images_and_valid_again(
    flying: Flying, fault: Callable[[Flying, bool], None], states: tuple[str, ...], named: str
) -> None:
    flying.until_sending()
    began_ns = time.monotonic_ns()
    fault(flying, True)
    flying.assert_ceased(began_ns)
    flying.daemon.line(named, after_ns=began_ns)
    seen = flying.until_source("camera", *states)
    assert "127.0.0.1" in seen["detail"], "which camera is to be told"
    fault(flying, False)
    right_ns = time.monotonic_ns()
    flying.until_source("camera", "running")
    flying.assert_soon(right_ns, time.monotonic_ns())
    flying.daemon.line("the camera is back", after_ns=right_ns)
    flying.assert_resumed(right_ns)
    flying.assert_true_poses()


def test_covered_for_two_seconds(flying: Flying) -> None:
    flying.until_sending()
    covered_ns = time.monotonic_ns()
    flying.camera.covered = True
    flying.assert_ceased(covered_ns)
    flying.daemon.until(lambda health: health["tracker"] == "lost", "it is lost")
    time.sleep(max(0.0, 2.0 - (time.monotonic_ns() - covered_ns) * 1e-9))
    flying.camera.covered = False
    seen_ns = time.monotonic_ns()
    flying.daemon.until(lambda health: health["tracker"] == "tracking", "it is found")
    flying.assert_soon(seen_ns, time.monotonic_ns())
    flying.assert_resumed(seen_ns)
    flying.until_told("vision position on", seen_ns)
    flying.assert_true_poses()


def test_a_tenth_of_the_pictures_lost(flying: Flying) -> None:
    flying.until_sending()
    began_ns = time.monotonic_ns()
    flying.camera.lost = 0.1
    time.sleep(4.0)
    flying.camera.lost = 0.0
    flying.assert_went_on(began_ns)
    flying.assert_true_poses()


def test_it_still_ends_in_time(flying: Flying) -> None:
    (folder,) = flying.daemon.flown()
    flying.assert_stops()
    # what has less than two seconds for its report may not manage, and then it is said
    late = flying.daemon.said("a stage did not give its last results in time: results")
    assert (folder / "report.json").exists() or late
    assert not flying.daemon.said("Traceback")
