"""Time from `companion run` to its first frames and its first pose, warm: the test pattern.

    python -m tests.bench.first_pose [--rounds 3]

Everything is on: dense map, recorder, results. The map begins with the motion of the pattern, after
some frames. The first round, whose files may not be in memory, is left out.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from companion.errors import SourceError
from drivers.system.status_socket import ask_status
from tests.support.processes.daemon_process import Daemon

UP_S = 120.0
EVERY_S = 0.01
SETTINGS = (
    "camera.source=pattern", "camera.rate_hz=30", "camera.width=640", "camera.height=480",
    "daemon.flight=always",
)  # fmt: skip


def steps_of(health: dict[str, Any]) -> dict[str, bool]:
    """What has been reached, by name, in order."""
    stages = {each["name"]: each for each in health["stages"]}
    sources = {each["name"]: each for each in health["sources"]}
    return {
        "it answers": True,
        "frames come": sources["camera"]["n"] > 0,
        "localisation has had a frame": stages.get("localisation", {}).get("rate_hz", 0) > 0,
        "the first pose": health["tracker"] == "tracking",
    }


def measured() -> dict[str, float]:
    """Seconds from the start of the process to each step."""
    found: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder, Daemon(Path(folder), *SETTINGS) as daemon:
        while "the first pose" not in found:
            now_s = (time.monotonic_ns() - daemon.started_ns) * 1e-9
            if now_s > UP_S:
                raise TimeoutError(f"no pose within {UP_S:g} s")
            with contextlib.suppress(SourceError, OSError):
                for name, reached in steps_of(ask_status(daemon.socket, 1.0)).items():
                    if reached:
                        found.setdefault(name, now_s)
            time.sleep(EVERY_S)
    return found


def print_steps(runs: list[dict[str, float]]) -> None:
    """Print a row for each step of a start: its median time and the spread of all runs."""
    for name in runs[0]:
        values = sorted(run[name] for run in runs)
        print(f"| {name} | {np.median(values):.2f} s | {values[0]:.2f} to {values[-1]:.2f} |")


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=3)
    with contextlib.redirect_stdout(sys.stderr):
        runs = [measured() for _ in range(parser.parse_args().rounds + 1)][1:]
    print_steps(runs)
    return 0


if __name__ == "__main__":
    sys.exit(main())
