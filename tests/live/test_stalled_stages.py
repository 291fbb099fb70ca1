"""A stage that hangs in flight is ended and restarted, and what it wrote is kept."""

from __future__ import annotations

import signal
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from drivers.recording.recording import Recording
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
