"""The sample flight's first seconds, replayed once for all tests that only read what it left."""

from __future__ import annotations

import dataclasses
import fcntl
import json
import os
from pathlib import Path

import pytest

from tests.support.processes.program import Run, replay_here

SAMPLE = Path(__file__).parents[2] / "sample" / "survey"
METRIC_S = 14
"""Time in which the flight gets its scale by positions, and poses are proven."""


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
