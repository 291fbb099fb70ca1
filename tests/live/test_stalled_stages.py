"""Stages that hang in flight are ended and restarted, and what they wrote is kept."""

from __future__ import annotations

import signal
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

from drivers.recording.recording_reader import RecordingReader
from tests.support.processes.daemon_process import Daemon

ANSWER_S, UP_S = 4.0, 120.0
KINDS = ("results", "recorder")
IMPATIENT = f"""
import sys
from dataclasses import replace
from companion.runtime.governor import Governor
from companion.daemon.flights import flown_stages
Governor.step = lambda self, t_ns, pressure: False
flown_stages.STAGES = [
    replace(stage, answer_s={ANSWER_S}) if stage.in_folder else stage
    for stage in flown_stages.STAGES
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


def works(health: dict[str, Any], kind: str) -> bool:
    return bool(stage_of(health, kind)["n"] > 5)


def test_what_hangs_in_flight_is_ended_and_begins_again(tmp_path: Path) -> None:
    settings = (
        "camera.source=pattern", "camera.width=320", "camera.height=240", "camera.rate_hz=10",
        "depth.enabled=false", "link.url=",
    )  # fmt: skip
    with Daemon(tmp_path, *settings, program=("-c", IMPATIENT)) as daemon:
        for kind in (*KINDS, "localisation"):
            daemon.until(partial(is_up, kind=kind, n_restarted=0), timeout_s=UP_S)
        for kind in KINDS:
            daemon.until(partial(works, kind=kind), timeout_s=UP_S)
        stopped_ns = {kind: daemon.signal_stage(kind, signal.SIGSTOP) for kind in KINDS}
        n_poses = stage_of(daemon.status(), "localisation")["n"]
        for kind in KINDS:
            ended = daemon.line(
                f"started again: {kind}: it hung for", after_ns=stopped_ns[kind], timeout_s=UP_S
            )
            assert ended.monotonic_ns - stopped_ns[kind] > (ANSWER_S - 2.0) * 1e9
        for kind in KINDS:
            daemon.until(partial(is_up, kind=kind, n_restarted=1), timeout_s=UP_S)
            daemon.until(partial(works, kind=kind), timeout_s=UP_S)
        assert stage_of(daemon.status(), "localisation")["n"] > n_poses, "poses went on"
        daemon.stop(60.0)
        assert not daemon.said("Traceback")
        (folder,) = daemon.flown()
    for part in (folder, folder / "part-2"):
        assert (part / "flight.rrd").stat().st_size > 10_000
        # the first is mended, which it was not closed for
        with closing(RecordingReader(part / "flight.mcap")) as recording:
            assert recording.pictures
