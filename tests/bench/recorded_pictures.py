"""Replays of a flight recorded with each codec, beside that of the flight itself.

    python -m tests.bench.recorded_pictures [FLIGHT]

FLIGHT is the sample unless given. All replays are in lockstep, without dense map. Distances are
between the poses of the recording's replay and those of the flight's, RMS, before and after the
best similarity.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from companion.config import CameraConfig, RecorderConfig, TelemetryConfig
from companion.products.report.comparison import compare_runs
from companion.products.run_folder import read_run
from drivers.open_flight import open_flight
from drivers.recording.importing import write_recording

SAMPLE = Path(__file__).parents[2] / "sample" / "survey"
ENCODINGS = (
    RecorderConfig(codec="raw"), RecorderConfig(codec="png"), RecorderConfig(codec="mjpeg"),
    RecorderConfig(codec="h264"),
)  # fmt: skip


def replay(flight: Path, out: Path) -> None:
    command = [sys.executable, "-m", "companion", "replay", str(flight), "--out", str(out)]
    subprocess.run([*command, "--set", "depth.enabled=false"], check=True)


def main() -> None:
    source = Path(sys.argv[1]) if len(sys.argv) > 1 else SAMPLE
    print("| codec | MB | apart | after alignment |\n" + "|---" * 4 + "|")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        replay(source, folder / "flight")
        for encoding in ENCODINGS:
            codec = encoding.codec
            recording = folder / f"{codec}.mcap"
            flight = open_flight(source, CameraConfig(), TelemetryConfig())
            write_recording(flight, recording, lambda n: None, encoding)
            replay(recording, folder / codec)
            poses = compare_runs(read_run(folder / "flight"), read_run(folder / codec)).poses
            print(
                f"| {codec} | {recording.stat().st_size / 1e6:.0f} | {poses.rms_m:.3f} m "
                f"| {poses.aligned_rms_m:.3f} m |",
                flush=True,
            )
            recording.unlink()


if __name__ == "__main__":
    main()
