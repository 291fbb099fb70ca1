"""A recorded flight is flown again at the desk: what the autopilot was sent, to the byte."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.config import CameraConfig, TelemetryConfig
from companion.estimation.gate.global_gate import IN_USE
from companion.estimation.gate.proof import MAP_RESUMED
from companion.estimation.site.site_use import LOCATED
from companion.telemetry import MEASURED, PositionSample
from drivers.recording.decisions import decisions_of
from drivers.recording.recorded_flight import open_recording
from tests.support.flights.halting import Halting
from tests.support.processes.flying import Flying
from tests.support.processes.program import Run, replay

LOADED_S = 4.0
MARKERS_M = 2.0
ENOUGH = 150
"""Messages with poses, however long they take on a busy machine."""
KEPT_S = 2.5
"""So long after the first pose the map is kept with its scale."""
BUSY = "while True: pass"


@contextmanager
def load() -> Iterator[None]:
    """Twice as much to do as the machine has processors for, hence frames that are dropped."""
    busy = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(4)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


def flown(folder: Path) -> Path:
    """A flight with load, a stage killed, markers below and satellites gone; its folder."""
    use = "attitude", "imu", "satellites"
    with Flying(
        folder, "recorder.codec=png", f"telemetry.use={list(use)}", "gps.switch_source=true",
        "landing.marker=apriltag_36h11", "landing.id=0", f"landing.size_m={MARKERS_M}",
        "feedback.flow=optical_flow", "feedback.obstacle_distance=true",
        has_imu=True,
    ) as flying:  # fmt: skip
        flying.camera.markers_m = MARKERS_M
        flying.take_off()
        assert flying.daemon.status()["believed"] == list(use)
        assert flying.daemon.said("is believed (telemetry.use)")
        flying.autopilot.gps = False
        wait_for_switch(flying, 1)
        flying.autopilot.gps = True
        flying.daemon.signal_stage("results", signal.SIGKILL)
        with load():
            time.sleep(LOADED_S)
        flying.camera.on = False
        time.sleep(1.0)
        flying.camera.on = True
        wait_for_switch(flying, 2)
        flying.autopilot.wait_for("LANDING_TARGET", 20, 60)
        flying.autopilot.wait_for("ODOMETRY", ENOUGH, 120)
        flying.autopilot.disarm()
        flying.daemon.line("results so far")
        (path,) = flying.daemon.flown()
        flying.daemon.stop()
    return path


def wait_for_switch(flying: Flying, n: int) -> None:
    """Wait until the EKF's sources have been switched so often."""
    switch = mavlink.MAV_CMD_SET_EKF_SOURCE_SET
    flying.autopilot.wait_for(
        "COMMAND_LONG", n, 60, lambda got: bool(got.message.command == switch)
    )


def again(path: Path, out: Path, *options: str) -> tuple[Run, dict[str, Any]]:
    done = replay(path, out, "--as-flown", *options)
    assert done.status == 0, done.stdout + done.stderr
    found: dict[str, Any] = json.loads((out / "as_flown.json").read_text())
    for gate in found["by_gate"].values():
        assert gate["same"] == gate["sent"] == gate["made_again"]
    return done, found


@pytest.mark.all_cores
def test_images_recorded_as_they_were_give_all_of_it_again(tmp_path: Path) -> None:
    """Of what was believed: what was not is in the recording as well."""
    path = flown(tmp_path)
    done, found = again(path, tmp_path / "again")
    recorded = open_recording(path / "flight.mcap", CameraConfig(), TelemetryConfig())
    with closing(recorded.recording):
        told = decisions_of(recorded.recording)
    assert told.config.telemetry.use == ("attitude", "imu", "satellites")
    without_frame = [step for step in told.frames if not step.has_picture]
    assert any(step.seq in told.odometry for step in without_frame), "poses by dead reckoning"
    assert {"attitude", "imu", "position", "satellites", "height"} <= {
        MEASURED[s.source if isinstance(s, PositionSample) else type(s)] for s in told.samples
    }
    assert found["tracked_again"]
    assert found["frames_same"] == found["frames"] > 100
    assert found["targets_same"] == found["targets"] > 100
    sent = {gate: each["sent"] for gate, each in found["by_gate"].items()}
    assert sent["pose"] > 100 and sent["landing"] >= 20 and sent["sources"] >= 2
    assert sent["obstacles"] > 100 and any(step.values.get("has_image") for step in told.gates)
    assert sent["flow"] > 100 and any(flow.quality for flow in told.flows.values())
    assert "the same to the byte" in done.stdout


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
        refused = replay(path, tmp_path / "refused", "--as-flown", *options)
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
        flying.autopilot.wait_for("ODOMETRY", ENOUGH, 60)
        time.sleep(KEPT_S)
        lost_ns = flying.daemon.signal_stage("localisation", signal.SIGKILL)
        flying.daemon.line(MAP_RESUMED, after_ns=lost_ns)
        flying.until_sending()
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
