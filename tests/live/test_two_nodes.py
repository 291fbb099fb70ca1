"""A drone that tracks and a ground that makes the map, joined over Zenoh: in two namespaces."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import pytest

from companion.daemon.nodes.kept_chunks import NAME
from companion.errors import SourceError
from drivers.system.status_socket import ask_status
from tests.support.processes.two_namespaces import TwoNamespaces, why_not
from tests.support.processes.zenoh_nodes import points_in
from tests.support.waiting import until

FLIGHT = Path(__file__).parents[2] / "sample" / "survey"
SLOWER = 3
"""The flight is flown so much slower, for both nodes share the processor of one machine."""
KBIT_S, DELAY_MS = 20_000, 10
PORT = 7447
RUN = (sys.executable, "-m", "companion", "run")


def slow_flight(folder: Path) -> Path:
    """The sample flight's pictures at longer intervals, without telemetry."""
    folder.mkdir()
    for name in ("camera.mp4", "camera.json"):
        (folder / name).symlink_to(FLIGHT / name)
    head, *rows = (FLIGHT / "frames.csv").read_text("utf-8").splitlines()
    times = [int(row.split(",")[1]) for row in rows]
    slow = [f"{k},{times[0] + SLOWER * (t - times[0])}" for k, t in enumerate(times)]
    (folder / "frames.csv").write_text("\n".join([head, *slow]) + "\n", "utf-8")
    return folder


class Nodes:
    """Both programs as their users run them, each in a namespace."""

    def __init__(self, air: TwoNamespaces, folder: Path) -> None:
        self._air, self.folder, self.socket = air, folder, folder / "drone.sock"
        self._log: IO[bytes] = (folder / "log").open("wb")
        self._running: list[subprocess.Popen[bytes]] = []
        self._flight = slow_flight(folder / "flight")

    def drone(self) -> subprocess.Popen[bytes]:
        return self._start(
            self._air.in_drone, "--stages", "tracking", "--set",
            f'distributed.listen=["tcp/{self._air.DRONE}:{PORT}"]', "--set", "camera.source=file",
            "--set", f"camera.path={self._flight}",
            "--set", f"camera.calibration={FLIGHT}/camera.json",
            "--set", f"expert.daemon.socket={self.socket}", "--set", "recorder.enabled=false",
            "--set", f"daemon.flights={self.folder}/drone",
        )  # fmt: skip

    def ground(self) -> subprocess.Popen[bytes]:
        return self._start(
            [*self._air.in_ground, "nice"], "--stages", "depth,cloud", "--join",
            f"tcp/{self._air.DRONE}:{PORT}", "--set", f"daemon.flights={self.folder}/ground",
        )  # fmt: skip

    def pose_n(self) -> int:
        """Poses that the drone has given so far."""
        with contextlib.suppress(SourceError):
            stages = ask_status(self.socket)["stages"]
            return next((int(s["n"]) for s in stages if s["name"] == "localisation"), 0)
        return 0

    @property
    def sent_bytes(self) -> int:
        """What has gone over the air to the ground."""
        return self._air.to_ground_bytes

    def kept_bytes(self) -> int:
        """Of the cloud on the ground."""
        return sum(p.stat().st_size for p in self.folder.glob(f"ground/*/{NAME}"))

    def close(self) -> None:
        for process in self._running:
            if process.poll() is None:
                process.kill()
            process.wait()
        self._log.close()
        print((self.folder / "log").read_text("utf-8", "replace"))

    def _start(self, namespace: list[str], *options: str) -> subprocess.Popen[bytes]:
        process = subprocess.Popen(
            [*namespace, *RUN, *options, "--set", "stream.listen="],
            stdout=self._log, stderr=self._log,
        )  # fmt: skip
        self._running.append(process)
        return process


@pytest.fixture
def nodes(tmp_path: Path) -> Iterator[Nodes]:
    reason = why_not()
    if reason and "namespaces" in os.environ.get("COMPANION_REQUIRE", ""):
        pytest.fail(reason)
    if reason:
        pytest.skip(reason)
    with TwoNamespaces(KBIT_S, DELAY_MS) as air:
        both = Nodes(air, tmp_path)
        try:
            yield both
        finally:
            both.close()


def test_the_ground_is_killed_and_restarted_and_its_map_grows_on(nodes: Nodes) -> None:
    ground, drone = nodes.ground(), nodes.drone()
    until(lambda: nodes.kept_bytes() > 0, "a cloud on the ground", 100)
    ground.kill()
    ground.wait()
    n_bytes, n_poses = nodes.kept_bytes(), nodes.pose_n()
    until(lambda: nodes.pose_n() > n_poses + 15, "poses without the ground")
    assert nodes.kept_bytes() == n_bytes
    again = nodes.ground()
    until(lambda: nodes.kept_bytes() > n_bytes + 1000, "more cloud on the ground", 100)
    again.send_signal(signal.SIGTERM)
    assert again.wait(60) == 0
    (folder,) = nodes.folder.glob("ground/*")
    assert points_in(folder) * 20 < nodes.kept_bytes() < 2000 * points_in(folder)
    assert (folder / "report.json").exists() and (folder / "flight-2.rrd").exists()
    assert nodes.sent_bytes > 300_000  # by no other way
    assert drone.poll() is None
    drone.send_signal(signal.SIGTERM)
    assert drone.wait(60) == 0
