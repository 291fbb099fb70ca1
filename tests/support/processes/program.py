"""The program as its users run it."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import companion.streaming.viewer  # noqa: F401 - Rerun keeps a runtime from its import on
from companion.app.cli import main


@dataclass(frozen=True)
class Run:
    """What a finished command left."""

    status: int
    stdout: str
    stderr: str
    out: Path

    @property
    def report(self) -> dict[str, Any]:
        """Its report.json."""
        report: dict[str, Any] = json.loads((self.out / "report.json").read_text("utf-8"))
        return report

    @property
    def n_sent(self) -> int:
        """Poses that a live flight would have sent."""
        lines = (self.out / "poses_sent.tum").read_text("utf-8").splitlines()
        return sum(not line.startswith("#") for line in lines)


def replay(flight: Path, out: Path, *options: str, timeout_s: float = 280) -> Run:
    """`companion replay`, in a process of its own."""
    command = [sys.executable, "-m", "companion", "replay", str(flight), "--out", str(out)]
    done = subprocess.run(
        [*command, *options], capture_output=True, text=True, timeout=timeout_s, check=False
    )
    return Run(done.returncode, done.stdout, done.stderr, out)


def replay_here(flight: Path, out: Path, *options: str) -> Run:
    """The same command in this process: for tests of what comes of a flight.

    A process of its own takes several seconds to load its libraries and compiled loops.
    """
    stdout, stderr = io.StringIO(), io.StringIO()
    with redirect_stdout(stdout), redirect_stderr(stderr):
        status = main(["replay", str(flight), "--out", str(out), *options])
    return Run(status, stdout.getvalue(), stderr.getvalue(), out)


def refused(run: Run) -> str:
    """The line that says what is wrong with the input, after making sure that it is all."""
    assert run.status == 2, run.stderr
    (line,) = run.stderr.splitlines()
    assert line.startswith("companion: error: ")
    return line
