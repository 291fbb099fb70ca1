"""A recorded flight is flown again at the desk: the poses that were sent, to the byte."""

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

from companion.config import MEASUREMENTS, CameraConfig, TelemetryConfig
from companion.telemetry import MEASURED, PositionSample
from drivers.recording.decisions import decisions_of
from drivers.recording.recorded_flight import open_recording
from tests.support.processes.flying import Flying
from tests.support.processes.program import Run, replay

FLY_S, LOADED_S = 8.0, 4.0
ENOUGH = 150
"""Messages with poses, however long they take on a busy machine."""
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


def flown(
    folder: Path, codec: str, use: tuple[str, ...] = MEASUREMENTS, has_imu: bool = False
) -> Path:
    """A flight with load, and with a stage killed; its folder."""
    codecs = f"recorder.codec={codec}", "recorder.jpeg_quality=90"
    with Flying(folder, *codecs, f"telemetry.use={list(use)}", has_imu=has_imu) as flying:
        flying.take_off()
        assert flying.daemon.status()["believed"] == list(use)
        assert bool(flying.daemon.said("is believed (telemetry.use)")) == (use != MEASUREMENTS)
        time.sleep(FLY_S)
        flying.daemon.signal_stage("results", signal.SIGKILL)
        with load():
            time.sleep(LOADED_S)
        flying.camera.on = False
        time.sleep(1.0)
        flying.camera.on = True
        time.sleep(FLY_S)
        flying.autopilot.wait_for("ODOMETRY", ENOUGH, 60)
        flying.autopilot.disarm()
        flying.daemon.line("results so far")
        (path,) = flying.daemon.flown()
        flying.daemon.stop()
    return path


def again(path: Path, out: Path) -> tuple[Run, dict[str, Any]]:
    done = replay(path, out, "--as-flown")
    assert done.status == 0, done.stdout + done.stderr
    found: dict[str, Any] = json.loads((out / "as_flown.json").read_text())
    return done, found


def test_images_recorded_as_they_were_give_all_of_it_again(tmp_path: Path) -> None:
    """Of what was believed: what was not is in the recording as well."""
    path = flown(tmp_path, "png", ("attitude", "imu", "satellites"), has_imu=True)
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
    assert found["same"] == found["sent"] == found["made_again"] > 100
    assert "the same to the byte" in done.stdout


def test_compressed_images_give_the_decisions_of_the_gate_again(tmp_path: Path) -> None:
    path = flown(tmp_path, "mjpeg")
    _, found = again(path, tmp_path / "again")
    assert not found["tracked_again"]
    assert found["same"] == found["sent"] == found["made_again"] > 100
