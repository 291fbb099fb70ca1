"""Whether viewers touch the pose: rate and delay of poses with none, with two, and with hung ones.

    python -m tests.bench.viewers_and_pose [--flight FOLDER] [--rounds N]

One daemon replays a flight, over and over; viewers come and go meanwhile, so that phases of one run
are compared. Delays are those from exposure to pose, as the daemon has them.
"""

from __future__ import annotations

import argparse
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

from tests.support.daemon import Daemon

PHASES = ("none", "two", "two that hang")
PHASE_S, SETTLE_S = 14.0, 6.0
"""The daemon's own figures are of the last 5 s."""


def viewers(port: int, folder: Path) -> list[subprocess.Popen[bytes]]:
    """Two that look on."""
    # they stand for other machines, whose work is not ours
    command = ["nice", "-n", "19", sys.executable, "-m", "tests.bench.links_ground"]
    command.append(f"127.0.0.1:{port}")
    return [
        subprocess.Popen(
            [*command, str(folder / f"{k}.json"), str(folder / f"{k}.rrd")],
            stderr=subprocess.DEVNULL,
        )
        for k in range(2)
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--flight", type=Path, default=Path("sample/survey"))
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    found: defaultdict[str, list[tuple[float, float, float]]] = defaultdict(list)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        settings = (
            "camera.source=file", f"camera.path={arguments.flight}", "camera.repeat=true",
            "daemon.flight=always", f"stream.listen=127.0.0.1:{port}", "depth.enabled=false",
        )  # fmt: skip
        with Daemon(folder, *settings) as daemon:
            daemon.until(lambda health: health["tracker"] == "tracking", 60)
            time.sleep(SETTLE_S)
            for n in range(arguments.rounds):
                # there and back, since the map grows meanwhile
                for phase in PHASES if n % 2 == 0 else reversed(PHASES):
                    looking = viewers(port, folder) if phase != "none" else []
                    time.sleep(SETTLE_S)
                    if phase == "two that hang":
                        for process in looking:
                            process.send_signal(signal.SIGSTOP)
                        time.sleep(SETTLE_S)
                    until_s = time.monotonic() + PHASE_S - SETTLE_S
                    while time.monotonic() < until_s:
                        stages = {s["name"]: s for s in daemon.status()["stages"]}
                        pose = stages["localisation"]
                        if pose["latency_p95_ms"] is not None:
                            found[phase].append(
                                (pose["rate_hz"], pose["latency_p50_ms"], pose["latency_p95_ms"])
                            )
                        time.sleep(0.5)
                    for process in looking:
                        process.kill()
                        process.wait()
    print("| viewers | poses a second | delay, median | 95th percentile |\n|---|---|---|---|")
    for phase, rows in found.items():
        rate, p50, p95 = np.median(np.array(rows), axis=0)
        print(f"| {phase} | {rate:.1f} | {p50:.1f} ms | {p95:.1f} ms |")


if __name__ == "__main__":
    main()
