"""The daemon as a child process: watched, queried, signalled, and always ended.

    with Daemon(tmp_path, "camera.source=pattern") as daemon:
        daemon.until(lambda health: health["tracker"] == "tracking")

Its socket and its flights lie in the folder given. What it says on standard error is kept by line,
each with the time it came, and printed at the end for whoever has to find out what went wrong.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import psutil

from companion.errors import SourceError
from drivers.system.status_socket import ask_status
from tests.support.processes.program import Run
from tests.support.waiting import PATIENCE_S

ASK_EVERY_S = 0.1
NOT_PASSED = "JOURNAL_STREAM", "PYTHONDONTWRITEBYTECODE"
"""Standard error is no journal; and an installed program has its bytecode: to compile it takes each
process a second of its start."""
PROGRAM = ("-m", "companion")
NO_GOVERNOR = """
import sys
from companion.runtime.governor import Governor
Governor.step = lambda self, t_ns, pressure: False
from companion.__main__ import main
sys.exit(main())
"""
UNGOVERNED = ("-c", NO_GOVERNOR)
"""The daemon on a machine that never seems too busy for viewers and a dense map."""


@dataclass(frozen=True, slots=True)
class Line:
    """A line of the journal, and when it came."""

    monotonic_ns: int
    text: str


class Daemon:
    """See above. Settings are as after `--set`."""

    def __init__(
        self, folder: Path, *settings: str, program: tuple[str, ...] = PROGRAM,
        config: Path | None = None,
    ) -> None:  # fmt: skip
        self.folder, self.flights = folder, folder / "flights"
        self.socket = folder / "run" / "status.sock"
        self.lines: list[Line] = []
        own = [
            f"expert.daemon.socket={self.socket}", f"daemon.flights={self.flights}",
            "stream.listen=", "page.listen=",
        ]  # fmt: skip
        self.settings = [*own, *settings]
        self._command = [sys.executable, *program, "run"]
        if config is not None:
            self._command += ["--config", str(config)]
        for setting in self.settings:
            self._command += ["--set", setting]
        self._came = threading.Condition()
        self._signalled: list[psutil.Process] = []
        self._process: subprocess.Popen[str] | None = None
        self._reader = threading.Thread(target=self._read, name="journal", daemon=True)

    def __enter__(self) -> Daemon:
        environment = {k: v for k, v in os.environ.items() if k not in NOT_PASSED}
        self.started_ns = time.monotonic_ns()
        self._process = subprocess.Popen(
            self._command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True,
            env=environment,
        )  # fmt: skip
        self._reader.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        process = self._running
        children = [*self._children(), *self._signalled]  # one that is stopped ends by no other way
        if process.poll() is None:
            process.kill()
        for child in children:
            with contextlib.suppress(psutil.Error):
                child.kill()
        process.wait()
        self._reader.join()
        assert process.stderr is not None
        process.stderr.close()
        for line in self.lines:
            print(f"{(line.monotonic_ns - self.started_ns) * 1e-9:8.3f} {line.text}")

    # -- what it says ----------------------------------------------------------------------------

    def status(self) -> dict[str, Any]:
        """What `companion status --json` shows; SourceError where it does not answer."""
        return ask_status(self.socket)

    def until(
        self, such: Callable[[dict[str, Any]], Any], what: str = "", *,
        timeout_s: float = PATIENCE_S,
    ) -> dict[str, Any]:  # fmt: skip
        """Its status once that is as wanted; AssertionError if it does not become so in time."""
        until_s = time.monotonic() + timeout_s
        health: dict[str, Any] = {}
        while time.monotonic() < until_s:
            assert self.running, f"it ended with status {self._running.returncode}"
            with contextlib.suppress(SourceError):
                health = self.status()
                if such(health):
                    return health
            time.sleep(ASK_EVERY_S)
        said = health.get("line", "it does not answer")
        raise AssertionError(f"not within {timeout_s:g} s: {what or 'as wanted'}; {said}")

    def line(self, text: str, *, after_ns: int = 0, timeout_s: float = PATIENCE_S) -> Line:
        """Wait for the first line with a text in it that came after a time."""
        until_s = time.monotonic() + timeout_s
        with self._came:
            while True:
                for each in self.lines:
                    if text in each.text and each.monotonic_ns >= after_ns:
                        return each
                left_s = until_s - time.monotonic()
                if left_s <= 0:
                    raise AssertionError(f"no line with {text!r} in {timeout_s:g} s")
                self._came.wait(left_s)

    def said(self, text: str) -> list[Line]:
        """All lines with a text in them, so far."""
        return [line for line in self.lines if text in line.text]

    def flown(self) -> list[Path]:
        """Folders of flights, in order."""
        return sorted(each for each in self.flights.glob("*") if each.is_dir())

    # -- what is done to it ----------------------------------------------------------------------

    @property
    def running(self) -> bool:
        """Whether it has not ended."""
        return self._running.poll() is None

    def send(self, number: signal.Signals) -> None:
        """Send it a signal."""
        self._running.send_signal(number)

    def stop(self, timeout_s: float = 30.0) -> float:
        """SIGTERM, and all that it says until it ends; how many seconds that took.

        AssertionError unless it ends well.
        """
        began_s = time.monotonic()
        self.send(signal.SIGTERM)
        status = self._running.wait(timeout_s)
        took_s = time.monotonic() - began_s
        self._reader.join(PATIENCE_S)
        assert status == 0, status
        return took_s

    def ended(self, timeout_s: float) -> Run:
        """Wait until it has ended by itself; what it left."""
        status = self._running.wait(timeout_s)
        self._reader.join()
        return Run(status, "", "\n".join(line.text for line in self.lines), self.flights)

    def stage(self, kind: str) -> int:
        """Process id of the newest process of a stage; AssertionError where there is none."""
        found = [
            (child.create_time(), child.pid)
            for child in self._children()
            if kind == self._name_of(child)
        ]
        assert found, f"there is no process of {kind}"
        return int(max(found)[1])

    def signal_stage(self, kind: str, number: signal.Signals) -> int:
        """Send a stage's process a signal; the time of it."""
        process = psutil.Process(self.stage(kind))
        self._signalled.append(process)
        process.send_signal(number)
        return time.monotonic_ns()

    def fill_disk_of(self, kind: str) -> int:
        """From now on a stage can write nothing more to any file; the time of it."""
        psutil.Process(self.stage(kind)).rlimit(psutil.RLIMIT_FSIZE, (0, 0))
        return time.monotonic_ns()

    @property
    def pid(self) -> int:
        """Of the daemon itself."""
        return self._running.pid

    # -- within ----------------------------------------------------------------------------------

    @property
    def _running(self) -> subprocess.Popen[str]:
        assert self._process is not None, "to be used in a with statement"
        return self._process

    def _children(self) -> list[psutil.Process]:
        try:
            return list(psutil.Process(self._running.pid).children(recursive=True))
        except psutil.Error:
            return []

    @staticmethod
    def _name_of(child: psutil.Process) -> str:
        try:
            return str(child.name())
        except psutil.Error:
            return ""

    def _read(self) -> None:
        stderr = self._running.stderr
        assert stderr is not None
        for text in stderr:
            with self._came:
                self.lines.append(Line(time.monotonic_ns(), text.rstrip("\n")))
                self._came.notify_all()
