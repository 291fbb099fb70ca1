"""One flight over one link: exporter and viewer in network namespaces, and measurements."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tests.support.processes.two_namespaces import TwoNamespaces

PORT = 9870
START_S = 4.0
"""What processes take to begin."""


@dataclass
class Trial:
    """What was measured; times are Unix seconds, of one machine."""

    began_s: float
    ended_s: float
    given: dict[str, float]
    """Times at which chunks of points were given to the exporter, by keyframe."""
    poses: list[tuple[float, float]]
    """When they were drawn, and of when they are."""
    coarse: dict[str, float]
    fine: dict[str, float]
    pictures: list[tuple[float, float, int]]
    exporter_mib: list[tuple[float, float]]
    ground_mib: list[tuple[float, float]]
    bytes_per_s: list[tuple[float, float]]
    """What was on the air towards the ground, each second."""
    n_connections: int
    dropped: int
    slowest_take_ms: float
    joined_s: float
    """When the viewer was given the first thing."""
    facts: dict[str, object] = field(default_factory=dict)

    def pose_age_s(self, since_s: float, until_s: float) -> np.ndarray:
        """How old the pose on the screen was, every 10 ms between two times."""
        at = np.array([p[0] for p in self.poses])
        samples = np.arange(since_s, until_s, 0.01)
        newest = np.searchsorted(at, samples, side="right") - 1
        ages: np.ndarray = samples - np.array([p[1] for p in self.poses])[np.maximum(newest, 0)]
        return ages

    def behind_s(self, level: str, since_s: float, until_s: float) -> np.ndarray:
        """How far behind the cloud was: the age of the oldest chunk missing, every 100 ms."""
        drawn: dict[str, float] = getattr(self, level)
        out = []
        for now_s in np.arange(since_s, until_s, 0.1):
            missing = [
                t for k, t in self.given.items() if t <= now_s and drawn.get(k, np.inf) > now_s
            ]
            out.append(now_s - min(missing) if missing else 0.0)
        return np.array(out)


def fly(
    link: TwoNamespaces, log: Path, folder: Path, seconds: float, budget_kbit_s: float = 0.0,
    meanwhile: Callable[[float, subprocess.Popen[bytes]], None] = lambda now_s, ground: None,
    joins_s: float = 0.0,
) -> Trial:  # fmt: skip
    """Play a message log over a link; `meanwhile` is called often, with seconds since the start.

    The viewer is started `joins_s` after that.
    """
    listen = f"{link.DRONE}:{PORT}"
    python = [sys.executable, "-m"]
    out = {side: folder / f"{side}.json" for side in ("drone", "ground")}
    drone = subprocess.Popen(
        [*link.in_drone, *python, "tests.bench.links_feeder", str(log), listen,
         str(budget_kbit_s), str(seconds), str(out["drone"])],
    )  # fmt: skip
    wait = ["sh", "-c", 'sleep "$0"; exec "$@"', str(joins_s)] if joins_s else []
    ground = subprocess.Popen(
        [*wait, *link.in_ground, *python, "tests.bench.links_ground", listen, str(out["ground"]),
         str(folder / "ground.rrd")], stderr=subprocess.DEVNULL,
    )  # fmt: skip
    time.sleep(START_S)
    began_s = time.time()
    rates: list[tuple[float, float]] = []
    n_before, looked_s = link.to_ground_bytes, began_s
    try:
        while drone.poll() is None:
            time.sleep(0.05)
            now_s = time.time()
            meanwhile(now_s - began_s, ground)
            if now_s - looked_s >= 1.0:
                n = link.to_ground_bytes
                rates.append((now_s, (n - n_before) / (now_s - looked_s)))
                n_before, looked_s = n, now_s
        ended_s = time.time()
        ground.send_signal(signal.SIGCONT)
        ground.terminate()
        ground.wait(30)
    finally:
        for process in (drone, ground):
            if process.poll() is None:
                process.kill()
                process.wait()
    sent, got = (json.loads(path.read_text()) for path in out.values())
    first: dict[str, dict[str, float]] = {"coarse": {}, "fine": {}}
    for level, drawn in got["points"].items():
        for keyframe_id, at_s in drawn:
            first[level].setdefault(keyframe_id, at_s)
    return Trial(
        began_s, ended_s, sent["given"], [tuple(p) for p in got["poses"]], first["coarse"],
        first["fine"], [tuple(p) for p in got["pictures"]],
        [tuple(p) for p in sent["memory_mib"]], [tuple(p) for p in got["memory_mib"]], rates,
        got["connections"], sent["dropped"], sent["slowest_take_ms"],
        got["first_s"] or np.inf, got["facts"],
    )  # fmt: skip
