"""A signal in the middle of a flight: what was finished is there, whole."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.support.reference.scoring import read_ply, read_tum

SAMPLE = Path(__file__).parents[2] / "sample" / "survey"


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_results_so_far(tmp_path: Path, number: signal.Signals, status: int) -> None:
    """Progress goes to a terminal of our own, which tells when the camera is tracked."""
    ours, theirs = os.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "companion", "replay", SAMPLE, "--out", tmp_path / "out"],
        stderr=theirs,
        stdout=subprocess.DEVNULL,
        env={**os.environ, "TERM": "xterm", "COLUMNS": "120"},
    )
    os.close(theirs)
    with process, os.fdopen(ours, "rb", buffering=0) as terminal:
        try:
            seen = read_until(terminal.fileno(), b"tracking", 60)
            time.sleep(3)
            process.send_signal(number)
            seen += read_until(terminal.fileno(), b"companion: stopped", 60)
            assert process.wait(30) == status
        finally:
            process.kill()
    assert b"Traceback" not in seen
    path = read_tum(tmp_path / "out" / "trajectory.tum")
    assert 5 < len(path.t_s) < 466
    assert len(read_ply(tmp_path / "out" / "cloud.ply")) >= 0
    assert (tmp_path / "out" / "report.json").exists()


def read_until(terminal: int, text: bytes, seconds: float) -> bytes:
    seen = b""
    end = time.monotonic() + seconds
    while text not in seen:
        ready, _, _ = select.select([terminal], [], [], max(0.0, end - time.monotonic()))
        assert ready, seen
        try:
            seen += os.read(terminal, 4096)
        except OSError as closed:  # the other end of a terminal closes so
            raise AssertionError(seen) from closed
    return seen
