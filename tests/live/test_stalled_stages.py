"""A stage that hangs stays within its queue's capacity, is ended, and is restarted."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from companion.config import Config
from companion.messages import DepthMap, Frame
from companion.runtime.parcel import Parcel
from companion.runtime.stage_process import StageProcess
from companion.runtime.stage_protocol import Setup
from companion.runtime.stages import QUEUE_BYTES, UNREAD_BYTES, stage_named
from companion.timing.clock import monotonic_s
from drivers.recording.recording import Recording
from tests.support.flights.topic_flight import CAMERA
from tests.support.processes.daemon_process import Daemon

ANSWER_S, UP_S = 4.0, 120.0
IMPATIENT = f"""
import sys
from dataclasses import replace
from companion.runtime.governor import Governor
from companion.daemon.flights import live_flight
Governor.step = lambda self, t_ns, pressure: False
live_flight.STAGES = [
    replace(stage, answer_s={ANSWER_S}) if stage.in_folder else stage
    for stage in live_flight.STAGES
]
from companion.__main__ import main
sys.exit(main())
"""
SIZE = 480, 640


def depth_map(number: int) -> DepthMap:
    """Five megabytes, each its own."""
    floats = [np.full(SIZE, number, np.float32) for _ in range(3)]
    return DepthMap(
        number, number, (500.0, 500.0, 320.0, 240.0), floats[0], floats[1],
        np.zeros(SIZE, np.uint8), floats[2], np.zeros((*SIZE, 3), np.uint8), 9, {},
    )  # fmt: skip


@pytest.fixture
def results(tmp_path: Path) -> Iterator[StageProcess]:
    ended: list[str] = []
    stage = StageProcess(stage_named("results"), lambda parcel: None, ended.append)
    stage.begin(Setup(Config(), CAMERA, tmp_path))
    try:
        until(lambda: stage.progress is not None)
        yield stage
    finally:
        stage.kill()


def until(such: object, timeout_s: float = 60.0) -> None:
    until_s = time.monotonic() + timeout_s
    while not such():  # type: ignore[operator]
        assert time.monotonic() < until_s
        threading.Event().wait(0.02)


def test_depth_maps_for_a_stage_that_is_stopped(results: StageProcess) -> None:
    psutil.Process(results.pid).suspend()
    before = psutil.Process().memory_info().rss
    for number in range(100):
        results.offer(Parcel.of(depth_map(number)))
    assert results.waiting_bytes <= QUEUE_BYTES
    assert psutil.Process().memory_info().rss - before < 2 * QUEUE_BYTES
    assert results.n_dropped >= 100 - (QUEUE_BYTES + UNREAD_BYTES) // 5_000_000 - 3
    until(lambda: results.stalled_s(monotonic_s()) > 1.5)


def test_a_stage_that_has_nothing_to_do_does_not_hang(results: StageProcess) -> None:
    """It says so by itself, and what it is offered it takes."""
    until(lambda: results.progress is not None and results.stalled_s(monotonic_s()) == 0.0)
    first = results.progress
    until(lambda: results.progress is not first)
    assert results.stalled_s(monotonic_s()) == 0.0
    frame = Frame(1, 1, np.zeros((96, 128), np.uint8), np.zeros((96, 128, 3), np.uint8))
    results.offer(Parcel.of(frame))
    until(lambda: results.progress is not None and results.progress.n_done == 1)
    until(lambda: results.stalled_s(monotonic_s()) == 0.0)


def stage_of(health: dict[str, Any], kind: str) -> dict[str, Any]:
    return next((each for each in health["stages"] if each["name"] == kind), {})


def is_up(health: dict[str, Any], kind: str, n_restarted: int) -> bool:
    found = stage_of(health, kind)
    return bool(
        found and found["alive"] and found["detail"] != "starting"
        and found["n_restarted"] == n_restarted
    )  # fmt: skip


@pytest.mark.parametrize("kind", ["results", "recorder"])
def test_what_hangs_in_flight_is_ended_and_begins_again(tmp_path: Path, kind: str) -> None:
    settings = "camera.source=pattern", "camera.rate_hz=10", "depth.enabled=false", "link.url="
    with Daemon(tmp_path, *settings, program=("-c", IMPATIENT)) as daemon:
        daemon.until(lambda health: is_up(health, kind, 0), UP_S)
        daemon.until(lambda health: is_up(health, "localisation", 0), UP_S)
        stopped_ns = daemon.signal_stage(kind, signal.SIGSTOP)
        n_poses = stage_of(daemon.status(), "localisation")["n"]
        ended = daemon.line(f"started again: {kind}: it hung for", UP_S, stopped_ns)
        assert ended.monotonic_ns - stopped_ns > (ANSWER_S - 2.0) * 1e9
        daemon.until(lambda health: is_up(health, kind, 1), UP_S)
        health = daemon.until(lambda health: stage_of(health, kind)["n"] > 5, UP_S)
        assert stage_of(health, "localisation")["n"] > n_poses, "poses went on"
        daemon.stop(60.0)
        assert not daemon.said("Traceback")
        (folder,) = daemon.flown()
    first, second = folder, folder / "part-2"
    if kind == "results":
        for part in (first, second):
            assert (part / "flight.rrd").stat().st_size > 10_000
        return
    for part in (first, second):  # the first is mended, which it was not closed for
        with closing(Recording(part / "flight.mcap")) as recording:
            assert recording.pictures
