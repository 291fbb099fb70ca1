"""A flight with a full load, a killed stage and more is flown again at the desk, to the byte."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.config import CameraConfig, TelemetryConfig
from companion.telemetry import MEASURED, PositionSample
from drivers.recording.decisions import decisions_of
from drivers.recording.recording_as_flight import open_recording
from tests.support.processes.as_flown import ENOUGH, again
from tests.support.processes.flying import Flying

LOADED_S = 4.0
MARKERS_M = 2.0
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


@pytest.mark.alone
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
