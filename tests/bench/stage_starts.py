"""Start of each stage, forked from the server and by an interpreter of its own: time and memory.

    python -m tests.bench.stage_starts [--rounds 3] [--stages viewers recorder]

From the start of the process until the stage is ready for messages, and its memory (PSS) then, in
which pages that several processes share count in parts. The server has the imports of this program
to share, as it has those of the daemon.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil

from companion.config import Config
from companion.geometry.camera import Camera
from companion.runtime.fork_server import ForkServer
from companion.runtime.stage_process import StageProcess
from companion.runtime.stage_protocol import Setup
from companion.runtime.stage_start import Start, start_alone
from companion.runtime.stages import STAGES, stage_named

CAMERA = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
PATIENCE_S, TICK_S = 300.0, 0.002
LEAST = [stage.name for stage in STAGES if stage.name != "topics"]
"""The stages of a flight on one computer."""


def started(name: str, start: Start, folder: Path) -> tuple[float, float]:
    """Seconds until a stage is ready, and its memory in MB."""
    began_s = time.monotonic()
    stage = StageProcess(stage_named(name), start, lambda parcel: None, lambda why: None)
    stage.begin(Setup(Config(), CAMERA, folder))
    try:
        while stage.progress is None:
            assert stage.alive and time.monotonic() < began_s + PATIENCE_S, stage.failed
            time.sleep(TICK_S)
        took_s = time.monotonic() - began_s
        assert stage.pid is not None
        return took_s, psutil.Process(stage.pid).memory_full_info().pss / 1e6
    finally:
        stage.kill()


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--stages", nargs="+", default=LEAST)
    arguments = parser.parse_args()
    print("| stage | alone, s | forked, s | alone, MB | forked, MB |\n|---|---|---|---|---|")
    with ForkServer(copy=True) as server, tempfile.TemporaryDirectory() as name:
        for stage in arguments.stages:
            alone, forked = [], []
            for n in range(arguments.rounds):
                alone.append(started(stage, start_alone, Path(name) / f"{stage}-alone-{n}"))
                forked.append(started(stage, server.start, Path(name) / f"{stage}-{n}"))
            (alone_s, alone_mb), (forked_s, forked_mb) = (
                np.median(rows, axis=0) for rows in (alone, forked)
            )
            times = f"{alone_s:.2f} | {forked_s:.2f}"
            print(f"| {stage} | {times} | {alone_mb:.0f} | {forked_mb:.0f} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
