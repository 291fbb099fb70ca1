"""A signal in the middle of a flight: what was finished is there, whole."""

from __future__ import annotations

import os
import re
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.reference.scoring import read_ply, read_tum

SAMPLE = Path(__file__).parents[2] / "sample" / "survey"
COMMAND = [sys.executable, "-m", "companion", "replay", str(SAMPLE)]
N_FRAMES, N_TRACKED = 466, 20
PATIENCE_S = 120.0
"""For a program to begin, or to write its results, on a machine that has much else to do."""


@pytest.mark.parametrize(
    ("number", "status", "dense"), [(signal.SIGINT, 130, "true"), (signal.SIGTERM, 143, "false")]
)
def test_results_so_far(tmp_path: Path, number: signal.Signals, status: int, dense: str) -> None:
    """Progress goes to a terminal of our own, which tells when the camera is tracked."""
    ours, theirs = os.openpty()
    process = subprocess.Popen(
        [
            *COMMAND,
            "--out",
            str(tmp_path / "out"),
            "--set",
            f"depth.enabled={dense}",
            "--set",
            "expert.depth.stride=8",
        ],
        stderr=theirs,
        stdout=subprocess.DEVNULL,
        env={**os.environ, "TERM": "xterm", "COLUMNS": "120"},
    )
    os.close(theirs)
    with process, os.fdopen(ours, "rb", buffering=0) as terminal:
        try:
            seen = read_until(terminal.fileno(), lambda seen: b"tracking" in seen)
            n_enough = n_done(seen) + N_TRACKED
            seen += read_until(terminal.fileno(), lambda seen: n_done(seen) > n_enough)
            process.send_signal(number)
            seen += read_until(terminal.fileno(), lambda seen: b"companion: stopped" in seen)
            assert process.wait(30) == status
        finally:
            process.kill()
    assert b"Traceback" not in seen
    path = read_tum(tmp_path / "out" / "trajectory.tum")
    assert 5 < len(path.t_s) < N_FRAMES
    assert len(read_ply(tmp_path / "out" / "cloud.ply")) >= 0
    assert (tmp_path / "out" / "report.json").exists()


def n_done(seen: bytes) -> int:
    """Frames that the newest progress bar shows as done."""
    shown = re.findall(rb"(\d+)/%d" % N_FRAMES, seen)
    return int(shown[-1]) if shown else 0


def read_until(terminal: int, such: Callable[[bytes], bool]) -> bytes:
    seen = b""
    end = time.monotonic() + PATIENCE_S
    while not such(seen):
        ready, _, _ = select.select([terminal], [], [], max(0.0, end - time.monotonic()))
        assert ready, seen
        try:
            seen += os.read(terminal, 4096)
        except OSError as closed:  # the other end of a terminal closes so
            raise AssertionError(seen) from closed
    return seen
