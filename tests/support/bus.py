"""Nodes joined by Zenoh on loopback, for tests of either side."""

from __future__ import annotations

import socket
from dataclasses import replace
from pathlib import Path

from companion.config import Config, DistributedConfig
from companion.stages.protocol import Setup
from companion.stages.topics_work import work
from companion.stages.work import Work
from tests.support import topic_flight


def free_endpoint() -> str:
    """An address of loopback where nobody listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def drone_config(endpoint: str, **changes: object) -> DistributedConfig:
    """Of a node with tracking that listens there."""
    config = DistributedConfig(True, ("tracking",), listen=(endpoint,), budget_kbit_s=0.0)
    return replace(config, **changes)  # type: ignore[arg-type]


def joined_config(endpoint: str) -> DistributedConfig:
    """Of a node with depth and cloud that joins there."""
    return DistributedConfig(True, ("depth", "cloud"), connect=(endpoint,))


def topics_of(endpoint: str, flights: Path, flight: str = "a-flight") -> Work:
    """The drone's stage of a made-up flight, in this process."""
    config = replace(Config(), distributed=drone_config(endpoint))
    return work(Setup(config, topic_flight.CAMERA, flights / flight))
