"""The sample flight, of which its log is read once, and its first seconds are replayed once."""

from __future__ import annotations

import dataclasses
import fcntl
import hashlib
import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.telemetry.log_readers import READERS
from drivers.telemetry.telemetry_log import LogContent
from drivers.telemetry.telemetry_tlog import read_tlog
from tests.support.processes.program import Run, replay_here

SAMPLE = Path(__file__).parents[2] / "sample" / "survey"
METRIC_S = 14
"""Time in which the flight gets its scale by positions, and poses are proven."""


@pytest.fixture(autouse=True, scope="session")
def logs_are_read_once() -> Iterator[None]:
    """What a log says does not depend on the replay, and reading it takes a third of a short one.

    By content and name: tests replay the same log from several folders.
    """
    read: dict[tuple[str, bytes], LogContent] = {}

    def read_once(path: Path) -> LogContent:
        key = path.name, hashlib.sha256(path.read_bytes()).digest()
        if key not in read:
            read[key] = read_tlog(path)
        return read[key]

    with pytest.MonkeyPatch.context() as patched:
        patched.setitem(READERS, ".tlog", read_once)
        yield


@pytest.fixture(scope="session")
def sample_begun(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """By the settings as they are, without the dense map; workers of pytest-xdist share it."""
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    kept = folder / "sample_begun.json"
    with (folder / "sample_begun.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not kept.exists():
            options = "--stop", str(METRIC_S), "--set", "depth.enabled=false"
            run = replay_here(SAMPLE, folder / "sample_begun", *options)
            assert run.status == 0, run.stderr
            kept.write_text(json.dumps(dataclasses.asdict(run), default=str))
    run = Run(**json.loads(kept.read_text()))
    return dataclasses.replace(run, out=Path(run.out))
