"""Effect of viewers on the pose: rate and delay with none, with two, and with hung ones.

    python -m tests.bench.viewers_and_pose [--flight FOLDER] [--rounds N]

One daemon follows the test pattern, or a flight over and over; viewers come and go meanwhile, so
that phases of one run are compared. Delays are those from exposure to pose, as the daemon has them.
What it leaves out where there is too much to do, viewers first, is not left out here.
"""

from __future__ import annotations

import argparse
import contextlib
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

from tests.support.processes.daemon_process import UNGOVERNED, Daemon

PHASES = ("none", "two", "two that hang")
RATE_HZ = 15.0
"""Of the test pattern; as many as leave the processor some room."""
MEASURES = ("rate_hz", "latency_p50_ms", "latency_p95_ms", "latency_p99_ms")
PHASE_S, SETTLE_S = 20.0, 6.0
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


def measured(flight: Path | None, rounds: int) -> dict[str, np.ndarray]:
    """By phase, one row for each round: poses a second, delay p50, p95 and p99 in ms."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    found: defaultdict[str, list[np.ndarray]] = defaultdict(list)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        camera: tuple[str, ...] = ("camera.source=pattern", f"camera.rate_hz={RATE_HZ:g}")
        if flight is not None:
            camera = "camera.source=file", f"camera.path={flight}", "expert.camera.repeat=true"
        settings = (
            *camera, "daemon.flight=always", f"stream.listen=127.0.0.1:{port}",
            "depth.enabled=false",
        )  # fmt: skip
        # what it said goes where it does not stand in a table
        with (
            contextlib.redirect_stdout(sys.stderr),
            Daemon(folder, *settings, program=UNGOVERNED) as daemon,
        ):
            daemon.until(lambda health: health["tracker"] == "tracking", timeout_s=60)
            time.sleep(SETTLE_S)
            for n in range(rounds):
                # there and back, since the map grows meanwhile
                for phase in PHASES if n % 2 == 0 else reversed(PHASES):
                    looking = viewers(port, folder) if phase != "none" else []
                    time.sleep(SETTLE_S)
                    if phase == "two that hang":
                        for process in looking:
                            process.send_signal(signal.SIGSTOP)
                        time.sleep(SETTLE_S)
                    found[phase].append(pose_loop(daemon))
                    for process in looking:
                        process.kill()
                        process.wait()
    return {phase: np.array(rows) for phase, rows in found.items()}


def pose_loop(daemon: Daemon) -> np.ndarray:
    """Of the next seconds: poses a second, delay p50, p95 and p99 in ms."""
    rows, until_s = [], time.monotonic() + PHASE_S - SETTLE_S
    while time.monotonic() < until_s:
        stages = {s["name"]: s for s in daemon.status()["stages"]}
        pose = stages["localisation"]
        if pose["latency_p99_ms"] is not None:
            rows.append([pose[name] for name in MEASURES])
        time.sleep(0.5)
    return np.median(np.array(rows), axis=0)


def rows_of(found: dict[str, np.ndarray]) -> list[tuple[str, str, str, bool]]:
    """What, measured, asked, and whether that holds: by how much the pose is worse with viewers.

    The first row says how far rounds without viewers differ: less than that cannot be told.
    """
    alone = np.median(found["none"], axis=0)
    spread = 100 * np.ptp(found["none"], axis=0) / alone
    names = ("rate", "p50", "p95", "p99")
    out = [("rounds without viewers differ by",
            ", ".join(f"{name} {s:.0f} %" for name, s in zip(names, spread, strict=True)),
            "-", True)]  # fmt: skip
    for phase in PHASES[1:]:
        now = np.median(found[phase], axis=0)
        worse = 100 * (now / alone - 1) * [-1, 1, 1, 1]
        for k in (0, 1, 2, 3):
            unit = "/s" if k == 0 else " ms"
            text = f"{worse[k]:+.1f} % ({alone[k]:.1f} to {now[k]:.1f}{unit})"
            asked = "< 5 %" if k in (0, 3) else "-"
            holds = worse[k] < 5 if k in (0, 3) else True
            out.append((f"pose {names[k]} worse with {phase} viewers", text, asked, bool(holds)))
    return out


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--flight", type=Path, help="instead of the test pattern")
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    rows = rows_of(measured(arguments.flight, arguments.rounds))
    print("| what | measured | asked | |\n|---|---|---|---|")
    for what, value, asked, holds in rows:
        print(f"| {what} | {value} | {asked} | {'' if holds else 'FAILS'} |")
    return 0 if all(row[3] for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
