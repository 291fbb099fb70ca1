"""Cost of recording: megabytes a minute, share of a core, and waiting for the disk.

    python -m tests.bench.recorder_cost [--flight sample/survey] [--seconds 20] [--out DIR]

Pictures of a flight, made 640 x 480, and a link's bytes go to a recorder at the speed of a live
flight. The share is processor time of this process, less what the feeding alone takes.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from companion.config import CameraConfig, Config, RecorderConfig
from companion.flight_notes import LinkBytes
from companion.geometry.camera import Camera
from companion.geometry.transforms import quaternion_from_euler
from companion.messages import Bytes, Frame
from companion.telemetry import AttitudeSample
from drivers.open_flight import open_flight
from drivers.recording.recorder import Recorder
from tests.support.flights.recorded import link_bytes

SIZE, RATE_HZ, LINK_HZ, ATTITUDE_HZ = (640, 480), 30.0, 120, 50
N_PICTURES = 60
CASES: list[tuple[Any, dict[str, Any]]] = [
    ("mjpeg", {"jpeg_quality": 80}), ("mjpeg", {}), ("mjpeg", {"jpeg_quality": 95}), ("h264", {}),
    ("png", {}), ("raw", {}), ("mjpeg", {"flush_s": 0.1}), ("mjpeg", {"flush_s": 1.0}),
]  # fmt: skip


def pictures(flight: Path) -> list[Bytes]:
    opened = open_flight(flight, CameraConfig())
    middle_ns = opened.times_ns[opened.n_frames // 3]
    found = (f.rgb for f in opened.frames(middle_ns) if isinstance(f, Frame))
    return [np.asarray(cv2.resize(rgb, SIZE), np.uint8) for rgb in islice(found, N_PICTURES)]


def fly(recorder: Recorder | None, rgbs: list[Bytes], seconds: float) -> float:
    """Processor time of a flight of so many seconds, recorded or not."""
    began_s, began_cpu_s = time.monotonic(), time.process_time()
    data = cycle([each.data for each in link_bytes(60)])
    greys = [np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8) for rgb in rgbs]
    epoch_ns = time.time_ns() - time.monotonic_ns()
    began_cpu_s = time.process_time()
    for seq in range(round(seconds * RATE_HZ)):
        due_s = began_s + seq / RATE_HZ
        time.sleep(max(0.0, due_s - time.monotonic()))
        t_ns = round(due_s * 1e9) + epoch_ns
        k = seq % len(rgbs)
        frame = Frame(seq, t_ns, greys[k], rgbs[k])
        turned = quaternion_from_euler(0.1, 0.2, seq * 0.01)
        sample = AttitudeSample(t_ns, turned, np.array([0.01, 0.02, 0.03 * seq]))
        if recorder is None:
            continue
        recorder.take(frame)
        for part in range(round(LINK_HZ / RATE_HZ)):
            recorder.take(LinkBytes(t_ns + part, t_ns - epoch_ns + part, False, next(data)))
        for _ in range(round(ATTITUDE_HZ / RATE_HZ)):
            recorder.take(sample)
    if recorder is not None:
        recorder.close()
    return time.process_time() - began_cpu_s


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--flight", type=Path, default=Path("sample/survey"))
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--out", type=Path, help="on which disk (default: a temporary folder)")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    rgbs = pictures(arguments.flight)
    camera = Camera(*SIZE, 500.0, 500.0, 319.5, 239.5)
    idle_s = fly(None, rgbs, arguments.seconds)
    print("pictures   setting               MB/min   % of a core   slowest write [ms]   dropped")
    for codec, changes in CASES:
        with tempfile.TemporaryDirectory(dir=arguments.out) as place:
            settings = RecorderConfig(codec=codec, least_free_mb=0, **changes)
            recorder = Recorder(Path(place), Config(recorder=settings), camera, {})
            spent_s = fly(recorder, rgbs, arguments.seconds) - idle_s
            n_bytes = sum(path.stat().st_size for path in Path(place).iterdir())
            os.sync()
        print(
            f"{codec:<10} {', '.join(f'{k} {v}' for k, v in changes.items()):<20}"
            f"{n_bytes / arguments.seconds * 60 / 1e6:>9.1f}"
            f"{100 * spent_s / arguments.seconds:>14.1f}{recorder.slowest_s * 1e3:>21.0f}"
            f"{recorder.n_dropped.total():>10}"
        )


if __name__ == "__main__":
    main()
