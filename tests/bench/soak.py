"""Soak test: a recorded flight flown repeatedly by one daemon in real time; growth and losses.

    python -m tests.bench.soak [--flight sample/survey] [--seconds 3600] [--out soak] [--set …]

Lap after lap a pretended autopilot arms, flies what was recorded and disarms, while the flight's
pictures are played as a camera; each lap is a flight with its recording, as a new map is asked for
after it, which is verified and deleted. Once a second all processes of the daemon are looked at.

Written are soak.csv (a row a second), laps.csv (a row a lap), journal.txt, soak.svg, and at the end
a few lines: rates, latency, and how fast memory, file handles and threads have grown once the
daemon was warm, after a quarter of an hour. Ctrl-C or SIGTERM ends it early. A day is
--seconds 86400. Exit status 1 where something was lost, restarted or has grown.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import json
import shutil
import signal
import socket
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from matplotlib.figure import Figure

from companion.config import CameraConfig
from companion.daemon.control.ground_control import NEW_MAP
from companion.errors import CompanionError
from drivers.open_flight import open_flight
from drivers.recording.recording_reader import RecordingReader
from tests.support.autopilot.fake_autopilot import FakeAutopilot
from tests.support.autopilot.fake_flight import RecordedFlight
from tests.support.autopilot.fake_wire import free_port
from tests.support.autopilot.ground_station import GroundStation
from tests.support.autopilot.received_poses import poses_of
from tests.support.processes.daemon_process import Daemon

LEAD_S, ARM_S, LAST_S = 6.0, 1.0, 1.0
WARM_S = 900.0
"""By then every buffer has had its largest load, and what is kept for the next flight is kept."""
PREDICTED_S = 0.008
"""An ODOMETRY that comes so soon after its stamp was predicted, not seen."""
LONG_ENOUGH_S = 2700.0
"""In less time what comes and goes looks like growth."""
MOST_GROWTH = {"memory_mb": 30.0, "daemon_mb": 20.0, "handles": 3.0, "threads": 2.0}
"""In an hour; most processes live for a flight, and only the daemon could grow for ever."""
KEYS = (
    "t_s", "lap", "camera_hz", "pose_p95_ms", "loop_p99_ms", "memory_mb", "daemon_mb", "handles",
    "threads", "processes", "cpu_share", "load", "camera_dropped", "restarts", "warnings",
)  # fmt: skip
LAP_KEYS = (
    "lap", "frames", "recorded", "lost", "whole", "poses", "latency_p50_ms", "latency_p99_ms",
    "longest_gap_s", "mb",
)  # fmt: skip


@dataclass
class Soak:
    """What was seen so far."""

    rows: list[dict[str, float]] = field(default_factory=list)
    laps: list[dict[str, float]] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)


def daemon_process() -> psutil.Process:
    return next(p for p in psutil.Process().children() if "companion" in p.cmdline())


def looked_at(began_s: float, lap: int, daemon: Daemon, process: psutil.Process) -> dict[str, Any]:
    """One row; what is ending just now is left out."""
    health: dict[str, Any] = {}
    with contextlib.suppress(CompanionError):
        health = daemon.status()
    memory, handles, threads, n = 0.0, 0, 0, 0
    daemon_mb = 0.0
    for each in [process, *process.children(recursive=True)]:
        with contextlib.suppress(psutil.Error):
            mb = each.memory_full_info().pss / 1e6
            memory, n = memory + mb, n + 1
            if each.pid == process.pid:
                daemon_mb, handles, threads = mb, each.num_fds(), each.num_threads()
    camera: dict[str, Any] = next(
        (s for s in health.get("sources", []) if s["name"] == "camera"), {}
    )
    return {
        "t_s": time.monotonic() - began_s, "lap": lap,
        "camera_hz": camera.get("rate_hz"), "pose_p95_ms": health.get("pose_latency_p95_ms"),
        "loop_p99_ms": health.get("loop_delay_p99_ms"), "memory_mb": memory,
        "daemon_mb": daemon_mb, "handles": handles, "threads": threads, "processes": n,
        "cpu_share": health.get("load", {}).get("cpu_share"), "load": psutil.getloadavg()[0],
        "camera_dropped": camera.get("n_dropped"),
        "restarts": sum(s["n_restarted"] for s in health.get("stages", [])),
        "warnings": sum(health.get("n_warnings", {}).values()),
    }  # fmt: skip


def lap_of(number: int, folder: Path, autopilot: FakeAutopilot) -> dict[str, Any]:
    """What a lap left behind; its folder is deleted."""
    with contextlib.closing(RecordingReader(folder / "flight.mcap")) as recording:
        seqs = [place.seq for place in recording.pictures]
        whole = not recording.warnings
    report = json.loads((folder / "report.json").read_text())
    got = list(autopilot.received)
    autopilot.received.clear()
    poses = poses_of(got)
    offset_s = time.time() - time.monotonic()
    late_s = poses.came_s + offset_s - poses.stamp_us * 1e-6
    seen_ms = late_s[late_s > PREDICTED_S] * 1e3
    row = {
        "lap": number, "frames": report["frames_in_flight"], "recorded": len(seqs),
        "lost": (seqs[-1] - seqs[0] + 1 - len(seqs)) if seqs else 0, "whole": whole,
        "poses": len(poses.came_s),
        "latency_p50_ms": float(np.percentile(seen_ms, 50)) if len(seen_ms) else None,
        "latency_p99_ms": float(np.percentile(seen_ms, 99)) if len(seen_ms) else None,
        "longest_gap_s": float(np.diff(poses.came_s).max()) if len(poses.came_s) > 1 else None,
        "mb": sum(p.stat().st_size for p in folder.rglob("*") if p.is_file()) / 1e6,
    }  # fmt: skip
    shutil.rmtree(folder)
    return row


def fly(arguments: argparse.Namespace) -> Soak:
    out, soak = arguments.out, Soak()
    flight = open_flight(arguments.flight, CameraConfig())
    n, span_ns = flight.n_frames, flight.times_ns[-1] - flight.times_ns[0]
    lap_s = (span_ns + span_ns // max(1, n - 1)) * 1e-9
    port, ground_port = free_port(), free_port(socket.SOCK_STREAM)
    begins_s = time.time() + LEAD_S
    settings = [
        "camera.source=file", f"camera.path={arguments.flight.absolute()}",
        f'router.clients=["tcpin:127.0.0.1:{ground_port}"]',
        "expert.camera.repeat=true", f"expert.camera.starts_at_unix_s={begins_s}",
        f"link.url=udpin:127.0.0.1:{port}", "feedback.mode=odometry", *arguments.set,
    ]  # fmt: skip
    autopilot = FakeAutopilot(
        "ardupilot", f"udpout:127.0.0.1:{port}", RecordedFlight(arguments.flight)
    )
    with (
        open(out / "soak.csv", "w", newline="") as rows_file,
        open(out / "laps.csv", "w", newline="") as laps_file,
        Daemon(out, *settings) as daemon,
        autopilot,
    ):
        rows = csv.DictWriter(rows_file, KEYS)
        laps = csv.DictWriter(laps_file, LAP_KEYS)
        rows.writeheader()
        laps.writeheader()
        process = daemon_process()
        began_s = begins_s + time.monotonic() - time.time()
        known: set[Path] = set()
        lap = 0
        try:
            while lap * lap_s < arguments.seconds:
                begin_s = began_s + lap * lap_s
                autopilot.fly(flight.start_ns, round(begin_s * 1e9), arm=False)
                armed = disarmed = False
                while (into_s := time.monotonic() - begin_s) < lap_s:
                    if not armed and into_s > ARM_S:
                        autopilot.arm()
                        armed = True
                    elif not disarmed and into_s > lap_s - LAST_S:
                        autopilot.disarm()
                        disarmed = True
                    row = looked_at(began_s, lap, daemon, process)
                    soak.rows.append(row)
                    rows.writerow(row)
                    rows_file.flush()
                    for path in sorted(set(daemon.flown()) - known):
                        if daemon.said(f"flight over: {path}"):
                            known.add(path)
                            done = lap_of(len(soak.laps), path, autopilot)
                            soak.laps.append(done)
                            laps.writerow(done)
                            laps_file.flush()
                    time.sleep(max(0.05, 1.0 - (time.monotonic() - began_s) % 1.0))
                autopilot.disarm()  # should the machine have been too busy before
                with GroundStation(ground_port) as ground:  # else the flight would go on
                    ground.command(NEW_MAP)
                lap += 1
        except KeyboardInterrupt:
            pass  # what was seen so far is told all the same
        daemon.stop()
        soak.wrong += [line.text for line in daemon.lines if "Traceback" in line.text]
    return soak


def growth_per_hour(soak: Soak, key: str) -> float:
    """Slope of what is usual in each lap, once warm; 0 where that is too short.

    The least and the most of a lap hang on how long the processes of two flights are there at once.
    """
    warm = [row for row in soak.rows if row["t_s"] > WARM_S]
    laps = sorted({row["lap"] for row in warm})
    if len(laps) < 3:
        return 0.0
    usual = [np.median([row[key] for row in warm if row["lap"] == lap]) for lap in laps]
    when = [min(row["t_s"] for row in warm if row["lap"] == lap) for lap in laps]
    return float(np.polyfit(when, usual, 1)[0] * 3600)


def verdict(soak: Soak) -> list[str]:
    """What is to be said of it; what is wrong goes to `soak.wrong`."""
    rows, laps = soak.rows, soak.laps
    lines = [f"{rows[-1]['t_s'] / 60:.1f} minutes, {len(laps)} flights"]

    def told(name: str, key: str, source: list[dict[str, float]], unit: str) -> None:
        values = np.array([row[key] for row in source if row[key] is not None], float)
        if len(values):
            lines.append(
                f"{name}: median {np.median(values):.1f}, 99 % {np.percentile(values, 99):.1f}, "
                f"most {values.max():.1f} {unit}"
            )

    told("camera", "camera_hz", [r for r in rows if r["lap"] >= 1], "frames/s")
    told("latency of a lap, p50", "latency_p50_ms", laps, "ms")
    told("latency of a lap, p99", "latency_p99_ms", laps, "ms")
    told("load of the machine", "load", rows, "")
    for key, most in MOST_GROWTH.items():
        grown = growth_per_hour(soak, key)
        lines.append(f"{key}: {rows[-1][key]:.0f} at the end, {grown:+.1f} an hour")
        if grown > most and rows[-1]["t_s"] > LONG_ENOUGH_S:
            soak.wrong.append(f"{key} grows by {grown:.1f} an hour")
    n_lost = sum(lap["lost"] for lap in laps)
    n_bad = sum(not lap["whole"] for lap in laps)
    lines.append(
        f"recorded: {sum(lap['recorded'] for lap in laps):.0f} frames, {n_lost:.0f} lost; "
        f"{n_bad} of {len(laps)} recordings not whole; stages restarted {rows[-1]['restarts']:.0f}"
    )
    if n_lost or n_bad or rows[-1]["restarts"]:
        soak.wrong.append("something was lost or restarted")
    return lines


def picture(soak: Soak, path: Path) -> None:
    """All over time."""
    minutes = [row["t_s"] / 60 for row in soak.rows]
    figure = Figure(figsize=(11, 10), layout="constrained")
    panels = figure.subplots(5, 1, sharex=True)
    for axes, keys, unit in zip(
        panels,
        (("camera_hz",), ("pose_p95_ms", "loop_p99_ms"), ("memory_mb", "daemon_mb"),
         ("handles", "threads", "processes"), ("load",)),
        ("frames/s", "ms", "MB", "", "load of the machine"), strict=True,
    ):  # fmt: skip
        for key in keys:
            values = [np.nan if row[key] is None else row[key] for row in soak.rows]
            axes.plot(minutes, values, lw=0.8, label=key)
        axes.set_ylabel(unit)
        axes.set_ylim(bottom=0)
        axes.legend(loc="upper right", frameon=False, ncols=3)
    panels[-1].set_xlabel("minutes")
    figure.savefig(path)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--flight", type=Path, default=Path("sample/survey"))
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--out", type=Path, default=Path("soak"))
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    with (arguments.out / "journal.txt").open("w") as journal, contextlib.redirect_stdout(journal):
        soak = fly(arguments)
    lines = verdict(soak)
    picture(soak, arguments.out / "soak.svg")
    print("\n".join([*lines, *(f"WRONG: {each}" for each in soak.wrong)]))
    return 1 if soak.wrong else 0


if __name__ == "__main__":
    sys.exit(main())
