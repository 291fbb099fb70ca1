"""Nodes joined by Zenoh on loopback, for tests of either side."""

from __future__ import annotations

import re
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import companion.streaming.viewer  # noqa: F401 - Rerun keeps a runtime from its import on
from companion.config import Config, DaemonConfig, DistributedConfig, StreamConfig
from companion.daemon.nodes.depth_node import DepthNode
from companion.runtime.stage_protocol import Setup
from companion.stages.topics_work import Topics
from tests.support.flights import topic_flight


def free_endpoint() -> str:
    """An address of loopback where nobody listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def drone_config(endpoint: str, **changes: object) -> DistributedConfig:
    """Of a node with tracking that listens there."""
    config = DistributedConfig(
        enabled=True, stages=("tracking",), listen=(endpoint,), budget_kbit_s=0.0
    )
    return replace(config, **changes)  # type: ignore[arg-type]


def joined_config(endpoint: str) -> DistributedConfig:
    """Of a node with depth and cloud that joins there."""
    return DistributedConfig(enabled=True, stages=("depth", "cloud"), connect=(endpoint,))


@contextmanager
def topics_of(
    endpoint: str, flights: Path, flight: str = "a-flight", **changes: object
) -> Iterator[Topics]:
    """The drone's stage of a made-up flight, in this process."""
    config = replace(Config(), distributed=drone_config(endpoint, **changes))
    stage = Topics(Setup(config, topic_flight.CAMERA, flights / flight))
    try:
        yield stage
    finally:
        stage.bus.close()


def ground_config(endpoint: str, folder: Path) -> Config:
    """Of a ground that joins there and writes into a folder."""
    return replace(
        Config(), distributed=joined_config(endpoint), stream=StreamConfig(listen=""),
        daemon=DaemonConfig(flights=str(folder / "ground")),
    )  # fmt: skip


class Ground:
    """A node with depth and cloud, in a thread of this process."""

    def __init__(self, config: Config) -> None:
        self._over = threading.Event()
        self._node = DepthNode(config, self._over.is_set)
        self._fault: BaseException | None = None
        self._thread = threading.Thread(target=self._work)
        self._thread.start()

    def stop(self) -> None:
        """End it; raises what brought it down, if anything did."""
        if self._over.is_set():
            return
        self._over.set()
        self._thread.join(60)
        self._node.close()
        if self._fault is not None:
            raise self._fault

    def _work(self) -> None:
        try:
            self._node.run()
        except BaseException as fault:
            self._fault = fault


def points_in(folder: Path) -> int:
    """Points of a finished run."""
    head = (folder / "cloud.ply").read_bytes()[:600].decode("ascii", "ignore")
    found = re.search(r"element vertex (\d+)", head)
    assert found is not None
    return int(found[1])
