"""The viewer on board: a process that shows a flight where it is made."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys

from companion.errors import InputError

GROUND = "companion.streaming.viewer.ground_process"
READY = b"ready"
"""Prefix of the line in which the viewer process reports its address for browsers."""
ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")


class OnboardViewer:
    """Process of a viewer, connected to the exporter of this machine."""

    def __init__(self, where: str, port: int, colours: str, web_bind: str) -> None:
        """Open `web`, `native`, or the viewer that runs at a rerun+http address.

        Raises InputError where no viewer can be reached or started.
        """
        environment = {**dict.fromkeys(ONE_THREAD, "1"), **os.environ}
        self._child = subprocess.Popen(
            [sys.executable, "-m", GROUND, where, str(port), colours, web_bind], env=environment,
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        assert self._child.stdout is not None
        answer = self._child.stdout.readline()
        ready, _, page = answer.partition(b" ")
        if ready != READY:
            self._end()
            said = answer.decode(errors="replace").strip() or "its process ended"
            raise InputError(f"--viewer {where}: {said}")
        self.page = page.decode().strip()
        """Address for a browser; "" for a window."""

    @property
    def pid(self) -> int:
        """Process id."""
        return self._child.pid

    @property
    def is_shown(self) -> bool:
        """True while its process runs."""
        return self._child.poll() is None

    def close(self, patience_s: float) -> None:
        """End it; by itself, in the time given, where it shows what it has."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._child.wait(patience_s)
        self._end()

    def _end(self) -> None:
        """End the process and its children; nothing where it has ended by itself."""
        if self._child.poll() is None:
            try:
                os.killpg(self._child.pid, signal.SIGKILL)
            except ProcessLookupError:  # it has not got so far as to have a group of its own
                self._child.kill()
            self._child.wait()
        assert self._child.stdout is not None
        self._child.stdout.close()
