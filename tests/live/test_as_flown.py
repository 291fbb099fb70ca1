"""A recorded flight is flown again at the desk: what the autopilot was sent, to the byte."""

from __future__ import annotations

import signal
import time
from contextlib import closing
from pathlib import Path

from companion.config import CameraConfig, TelemetryConfig
from companion.estimation.gate.global_gate import IN_USE
from companion.estimation.gate.proof import MAP_RESUMED
from companion.estimation.site.site_use import LOCATED
from drivers.recording.decisions import decisions_of
from drivers.recording.recording_as_flight import open_recording
from tests.support.flights.halting import Halting
from tests.support.processes.as_flown import ENOUGH, again
from tests.support.processes.flying import Flying
from tests.support.processes.program import replay_here

KEPT_S = 2.5
"""So long after the first pose the map is kept with its scale."""


def ended(flying: Flying) -> Path:
    """The folder of the flight, once it has left all results: its map, too."""
    flying.autopilot.disarm()
    flying.daemon.send(signal.SIGINT)
    assert flying.daemon.ended(120).status == 0
    (path,) = flying.daemon.flown()
    return path


def test_a_flight_in_the_map_of_an_earlier_one_is_flown_again_in_that_map(tmp_path: Path) -> None:
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
    with Flying(tmp_path / "first", "recorder.enabled=false") as flying:
        flying.take_off()
        flying.autopilot.wait_for("ODOMETRY", ENOUGH, 60)
        path = ended(flying)
    site_map = path / "site.map"
    settings = "recorder.codec=png", f"map.use={site_map}"
    with Flying(tmp_path / "second", *settings) as flying:
        flying.take_off()
        flying.daemon.line(LOCATED)
        flying.autopilot.wait_for("ODOMETRY", ENOUGH, 60)
        path = ended(flying)
    moved, other = site_map.rename(tmp_path / "moved.map"), path / "site.map"
    assert other.exists()
    for options in ((), ("--map", str(other))):
        refused = replay_here(path, tmp_path / "refused", "--as-flown", *options)
        assert refused.status and "--map FILE names it" in refused.stderr
    _, found = again(path, tmp_path / "again", "--map", str(moved))
    assert found["frames_same"] == found["frames"] > 50


def test_compressed_images_give_the_decisions_of_the_gates_again(tmp_path: Path) -> None:
    with Flying(
        tmp_path, "recorder.codec=mjpeg", "feedback.flow=optical_flow_rad",
        "feedback.obstacle_distance=true",
    ) as flying:  # fmt: skip
        flying.take_off()
        flying.autopilot.wait_for("ODOMETRY", ENOUGH, 120)
        flying.autopilot.disarm()
        flying.daemon.line("results so far")
        (path,) = flying.daemon.flown()
        flying.daemon.stop()
    done, found = again(path, tmp_path / "again")
    assert not found["tracked_again"]
    assert found["not_made_again"]["obstacles"] > 20 and "compressed with losses" in done.stdout
    assert found["by_gate"]["pose"]["sent"] > 100 and found["by_gate"]["flow"]["sent"] > 100


def test_a_flight_that_went_on_with_the_map_of_a_process_before_is_flown_again(
    tmp_path: Path,
) -> None:
    way = Halting()
    with Flying(tmp_path, "recorder.codec=png", path=way) as flying:
        flying.take_off()
        time.sleep(KEPT_S)
        way.hover()
        time.sleep(KEPT_S)
        flying.start_again(signal.SIGKILL)
        flying.until_sending()
        sent_ns = time.monotonic_ns()
        flying.autopilot.wait_for("ODOMETRY", ENOUGH, 60, lambda got: got.monotonic_ns >= sent_ns)
        time.sleep(KEPT_S)
        lost_ns = flying.daemon.signal_stage("localisation", signal.SIGKILL)
        flying.daemon.line(MAP_RESUMED, after_ns=lost_ns)
        flying.autopilot.wait_for("ODOMETRY", ENOUGH, 60, lambda got: got.monotonic_ns >= lost_ns)
        flying.autopilot.disarm()
        flying.daemon.line("results so far")
        _, by_daemon, by_localisation = flying.daemon.flown()
        flying.daemon.stop()
    for path in by_daemon, by_localisation:
        recorded = open_recording(path / "flight.mcap", CameraConfig(), TelemetryConfig())
        with closing(recorded.recording):
            told = decisions_of(recorded.recording)
        assert any(event.startswith(MAP_RESUMED) for event in told.events)
        _, found = again(path, tmp_path / f"again-{path.name}")
        assert found["tracked_again"] and found["frames_same"] == found["frames"] > 30
        assert found["by_gate"]["pose"]["sent"] > 10


def test_global_positions_are_made_again_where_poses_are_not_sent(tmp_path: Path) -> None:
    with Flying(
        tmp_path, "recorder.codec=mjpeg", "feedback.mode=off", "feedback.global_position=sensor"
    ) as flying:
        flying.autopilot.arm()
        flying.daemon.until(
            lambda health: health["global_position"]["why_not"] == IN_USE, "a place by satellites"
        )
        flying.autopilot.gps = False
        flying.autopilot.wait_for("GLOBAL_POSITION_SENSOR", 20, 120)
        flying.autopilot.gps = True
        flying.until_told("global position by vision off", time.monotonic_ns())
        flying.autopilot.disarm()
        flying.daemon.line("results so far")
        (path,) = flying.daemon.flown()
        flying.daemon.stop()
    _, found = again(path, tmp_path / "again")
    assert not found["tracked_again"]
    assert found["by_gate"]["global"]["sent"] >= 20 and set(found["by_gate"]) == {"global"}
