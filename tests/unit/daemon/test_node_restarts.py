"""A ground node, or the drone, begins anew: the map on the ground goes on, or does too."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from companion.daemon.nodes.kept_chunks import NAME
from companion.runtime.stage_protocol import Finish
from tests.support.flights import topic_flight
from tests.support.processes.zenoh_nodes import (
    Ground,
    free_endpoint,
    ground_config,
    points_in,
    topics_of,
)
from tests.support.waiting import until


@pytest.fixture
def closing() -> Iterator[ExitStack]:
    """Closes what a test has opened, however it ends."""
    with ExitStack() as stack:
        yield stack


def test_a_node_goes_on_with_its_map_after_a_restart(tmp_path: Path, closing: ExitStack) -> None:
    endpoint = free_endpoint()
    messages = list(topic_flight.messages(130))
    first = Ground(ground_config(endpoint, tmp_path))  # before the drone is there
    closing.callback(first.stop)
    drone = closing.enter_context(topics_of(endpoint, tmp_path))
    for message in messages[: len(messages) // 2]:
        drone.step(message)
    folder = tmp_path / "ground" / "drone-a-flight"
    kept = folder / NAME
    until(lambda: kept.exists() and kept.stat().st_size > 2000, "a cloud")
    first.stop()
    n_first, n_kept = points_in(folder), kept.stat().st_size
    assert n_first > 50
    for message in messages[len(messages) // 2 :]:
        drone.step(message)  # nobody is there, and it takes no notice
    second = Ground(ground_config(endpoint, tmp_path))
    closing.callback(second.stop)
    second.stop()  # before it has heard of the drone: what is there stays
    assert points_in(folder) == n_first
    third = Ground(ground_config(endpoint, tmp_path))
    closing.callback(third.stop)
    until(lambda: kept.stat().st_size > n_kept, "more cloud")
    drone.finish(Finish(hurry=False))  # waits for who fetches
    third.stop()
    assert points_in(folder) > 1.3 * n_first
    assert kept.stat().st_size > n_kept


def test_the_drone_begins_anew_and_so_does_its_map(tmp_path: Path, closing: ExitStack) -> None:
    endpoint = free_endpoint()
    messages = list(topic_flight.messages(130))
    folders = [tmp_path / "ground" / f"drone-{name}" for name in ("a-flight", "b-flight")]

    def kept_bytes(folder: Path) -> int:
        return (folder / NAME).stat().st_size if (folder / NAME).exists() else 0

    ground = Ground(ground_config(endpoint, tmp_path))
    closing.callback(ground.stop)
    with topics_of(endpoint, tmp_path) as topics:
        for message in messages[:180]:
            topics.step(message)
        until(lambda: kept_bytes(folders[0]) > 2000, "a cloud")
    before = kept_bytes(folders[0])
    with topics_of(endpoint, tmp_path) as topics:  # the same flight, another process
        for message in messages[180:]:
            topics.step(message)
        until(lambda: kept_bytes(folders[0]) > before, "more of this cloud")
    with topics_of(endpoint, tmp_path, "b-flight") as topics:
        for message in messages:
            topics.step(message)
        until(lambda: kept_bytes(folders[1]) > 2000, "a cloud of the next flight")
    ground.stop()
    assert all(points_in(folder) > 50 for folder in folders)
