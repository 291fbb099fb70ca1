"""An hour of map, ten million points, to a viewer connected throughout and to one at the end.

    python -m tests.bench.long_map [--keyframes N]

Prints the memory of the exporter and of the viewers along the way, how long the late one takes, and
what goes out when all of the map is found to be two percent longer, as a loop that closes has it.
"""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil

from companion.config import StreamConfig, ViewerConfig
from companion.geometry.camera import Camera
from companion.geometry.transforms import Pose
from companion.messages import SPANS_REACH, KeyframeAdded, MapUpdate, Track, TrackState
from companion.streaming.live_viewer import LiveViewer
from companion.streaming.viewer.web_proxy import free_ports
from tests.support.flights import flown

POINTS = 2800
EACH_S, MOST_WAITING_BYTES = 0.012, 4 << 20
"""An hour in a minute, or slower where the exporter cannot: this is about memory, not speed."""
MAP_EVERY = 30
"""Keyframes from one map to the next: live there is one for each."""
LONGER = 1.02
ADJUSTED_S = 5.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--keyframes", type=int, default=3600)
    n_keyframes = parser.parse_args().keyframes
    camera = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)
    (port,) = free_ports(1)
    chunks = [flown.chunk(k, POINTS) for k in range(12)]

    def viewer_in(folder: Path, name: str) -> psutil.Popen:
        command = [sys.executable, "-m", "tests.bench.links_ground", f"127.0.0.1:{port}"]
        return psutil.Popen(
            [*command, str(folder / f"{name}.json"), str(folder / f"{name}.rrd")],
            stderr=subprocess.DEVNULL,
        )

    def mib(process: psutil.Process) -> float:
        return float(process.memory_info().rss / 2**20)

    stream = StreamConfig(listen=f"127.0.0.1:{port}")
    with (
        tempfile.TemporaryDirectory() as name,
        LiveViewer(ViewerConfig(), camera, name="hour", stream=stream) as live,
    ):
        exporter, folder = psutil.Process(live.stage.pid), Path(name)
        first = viewer_in(folder, "first")
        places: dict[int, Pose] = {}
        print("| keyframes | points | exporter | viewer |\n|---|---|---|---|")
        for k in range(n_keyframes):
            t_ns = flown.START_NS + k * 1_000_000_000
            place = flown.map_from_camera(k % flown.N_FRAMES)
            shift = place.translation + np.array([0.01 * k, 0, 0])
            place = replace(place, translation=shift)
            live.take(KeyframeAdded(k, k, t_ns, place, np.zeros((0, 3))))
            places[k] = place
            spans = {
                other: float(np.linalg.norm(places[other].translation - place.translation))
                for other in range(max(0, k - SPANS_REACH), k)
            }
            live.take(replace(chunks[k % 12], keyframe_id=k, t_ns=t_ns, spans=spans))
            relative = flown.track(20).map_from_camera
            live.take(Track(k, t_ns, TrackState.TRACKING, place, k, relative))
            if (k + 1) % MAP_EVERY == 0:
                live.take(MapUpdate(k, t_ns, dict(places), np.zeros((0, 3)), None))
            time.sleep(EACH_S)
            while live.stage.waiting_bytes > MOST_WAITING_BYTES:
                time.sleep(EACH_S)
            if (k + 1) % (n_keyframes // 6) == 0:
                row = (k + 1, (k + 1) * POINTS, mib(exporter), mib(first))
                print("| {} | {} | {:.0f} MiB | {:.0f} MiB |".format(*row), flush=True)
        late = viewer_in(folder, "late")
        began_s = time.time()
        time.sleep(25)
        longer = {k: Pose(p.rotation, LONGER * p.translation) for k, p in places.items()}
        adjusted_s = time.time()
        live.take(MapUpdate(n_keyframes, t_ns + 1, longer, np.zeros((0, 3)), None))
        time.sleep(ADJUSTED_S)
        print(f"at the end: exporter {mib(exporter):.0f} MiB, {live.report}, dropped "
              f"{live.n_dropped}")  # fmt: skip
        for process in (first, late):
            process.send_signal(signal.SIGTERM)
            process.wait(60)
        for each in ("first", "late"):
            got = json.loads((folder / f"{each}.json").read_text())
            levels = {level: len({k for k, _ in at}) for level, at in got["points"].items()}
            line = f"{each}: {levels}, {got['bytes'] / 1e6:.1f} MB"
            if each == "late":
                before = max(n for at, n in got["came"] if at < adjusted_s)
                line += f", {(got['bytes'] - before) / 1e3:.0f} kB of them for a longer map"
                for level, at in got["points"].items():
                    line += f", {level} complete after {max(t for _, t in at) - began_s:.1f} s"
            print(line)


if __name__ == "__main__":
    main()
