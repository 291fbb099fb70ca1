"""Live viewers of a flight: an exporter in a process of its own, and a viewer on board.

Links and viewers are served there. No failure of theirs makes the caller wait.
"""

from __future__ import annotations

import json
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping
from types import TracebackType
from typing import Any

from companion.config import StreamConfig, ViewerConfig
from companion.errors import InputError
from companion.geometry.camera import Camera
from companion.geometry.geodesy import GeoOrigin
from companion.messages import Frame
from companion.streaming.export_process import ExportSetup, SetBudget
from companion.streaming.items import FlightItem
from companion.streaming.scene_encoder import Watched
from companion.streaming.viewer.inbox import Inbox
from companion.streaming.viewer.reduced import SHOWN, reduced
from companion.timing.clock import monotonic_s

CAPACITY_BYTES = 32 << 20
PATIENCE_S = 3.0
START_S = 30.0
READY = b"ready"
"""Prefix of the line in which the viewer process reports its address for browsers."""
EXPORTER, GROUND = "companion.streaming.export_process", "companion.streaming.viewer.ground_process"
NOWHERE = "none"
FRAME_EVERY_NS = 60_000_000
"""Least interval of frames for viewers."""
ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")


class LiveViewer:
    """Exports a flight to viewers that connect to `stream.listen`; `look` opens one here, too.

    Messages beyond the capacity are dropped and counted. `where` is as for `look`.
    """

    def __init__(
        self, config: ViewerConfig, camera: Camera, where: str = NOWHERE, name: str = "",
        stream: StreamConfig | None = None, origin: GeoOrigin | None = None,
    ) -> None:  # fmt: skip
        self.n_dropped = 0
        self.report: Mapping[str, Any] = {}
        """Last report of the exporter."""
        self.closed = ""
        """Reason why nobody can connect, or ""."""
        self.page = ""
        """Address for a browser; "" for a window."""
        self._config, self._width = config, min(config.image_width, camera.width)
        self._inbox = Inbox(CAPACITY_BYTES)
        self._budget: SetBudget | None = None
        """Change to be sent to the exporter."""
        self._frame_ns = -(2**63)
        self._port = 0
        self._has_port = threading.Event()
        self._sending_since_s: float | None = None
        listen = stream.listen if stream is not None else ""
        self._bind = stream.web_bind if stream is not None else StreamConfig().web_bind
        flight = FlightItem(name or os.urandom(8).hex(), name, camera.pinhole(), origin)
        setup = ExportSetup(
            flight, stream or StreamConfig(), listen, int(where not in (NOWHERE, ""))
        )
        self._exporter = _child(EXPORTER, stdin=True)
        self._ground: subprocess.Popen[bytes] | None = None
        self._thread = threading.Thread(
            target=self._work, args=(setup,), name="viewer", daemon=True
        )
        self._listener = threading.Thread(target=self._listen, name="exporter", daemon=True)
        self._thread.start()
        self._listener.start()
        if where != NOWHERE:
            try:
                self.look(where)
            except BaseException:
                self.close(0.0)
                raise

    def take(self, message: Watched) -> None:
        """Queue one message, or drop it."""
        if not isinstance(message, SHOWN):
            return
        if isinstance(message, Frame):
            if message.t_ns - self._frame_ns < FRAME_EVERY_NS:
                return
            self._frame_ns = message.t_ns
        if not self._inbox.offer(message):
            self.n_dropped += 1

    def set_budget(self, kbit_s: float) -> None:
        """Limit the rate of all viewers together from the next message on; 0 for no limit."""
        self._budget = SetBudget(kbit_s)

    def look(self, where: str) -> None:
        """Open a viewer: `web`, `native`, or the rerun+http address of one that runs.

        Raises InputError where no viewer can be reached or started.
        """
        if not self._has_port.wait(START_S) or not self._port:
            raise InputError(f"--viewer {where}: the exporter ended as it began")
        child = _child(GROUND, where, str(self._port), self._config.colours, self._bind)
        assert child.stdout is not None
        answer = child.stdout.readline()
        ready, _, page = answer.partition(b" ")
        if ready != READY:
            _end(child)
            said = answer.decode(errors="replace").strip() or "its process ended"
            raise InputError(f"--viewer {where}: {said}")
        if self._ground is not None:
            _end(self._ground)
        self._ground, self.page = child, page.decode().strip()

    @property
    def pid(self) -> int:
        """Process id of the exporter."""
        return self._exporter.pid

    @property
    def alive(self) -> bool:
        """Whether the exporter runs."""
        return self._exporter.poll() is None

    def stalled_s(self, now_s: float) -> float:
        """Seconds for which the exporter has not read a message; 0 where none waits."""
        since_s = self._sending_since_s
        return now_s - since_s if since_s is not None else 0.0

    def interrupt(self) -> None:
        """End an exporter that hangs, as if it had died by itself."""
        _end(self._exporter)

    @property
    def is_shown(self) -> bool:
        """Whether the process of the viewer here runs."""
        return self._ground is not None and self._ground.poll() is None

    def __enter__(self) -> LiveViewer:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close(PATIENCE_S)

    def close(self, patience_s: float) -> None:
        """Send what is queued, and end; each in the time given."""
        self._inbox.close()
        self._thread.join(patience_s)
        children = [child for child in (self._exporter, self._ground) if child is not None]
        try:
            if not self._thread.is_alive():
                for child in children:
                    child.wait(patience_s)
        except subprocess.TimeoutExpired:
            pass  # it hangs, and is ended below
        finally:
            for child in children:
                _end(child)
        for thread in (self._thread, self._listener):
            thread.join(PATIENCE_S)
        self.n_dropped += len(self._inbox)

    def _work(self, setup: ExportSetup) -> None:
        try:
            self._send(setup)
            while (message := self._inbox.get()) is not None:
                self._sending_since_s = monotonic_s()
                budget, self._budget = self._budget, None
                if budget is not None:
                    self._send(budget)
                self._send(reduced(message, self._width))
                self._sending_since_s = None
        except OSError:  # the exporter is gone; the flight goes on, and what follows is counted
            self.n_dropped += 1
            self._inbox.close()
        finally:
            _close(self._exporter.stdin)

    def _listen(self) -> None:
        assert self._exporter.stdout is not None
        for line in self._exporter.stdout:
            said = json.loads(line)
            self.report = said.get("report", self.report)
            self.closed = str(said.get("closed", ""))
            if "own" in said:
                self._port = int(said["own"])
                self._has_port.set()
        self._has_port.set()
        _close(self._exporter.stdout)

    def _send(self, thing: object) -> None:
        assert self._exporter.stdin is not None
        pickle.dump(thing, self._exporter.stdin, protocol=pickle.HIGHEST_PROTOCOL)
        self._exporter.stdin.flush()


def _child(module: str, *arguments: str, stdin: bool = False) -> subprocess.Popen[bytes]:
    environment = {**dict.fromkeys(ONE_THREAD, "1"), **os.environ}
    return subprocess.Popen(
        [sys.executable, "-m", module, *arguments], env=environment,
        stdin=subprocess.PIPE if stdin else subprocess.DEVNULL, stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )  # fmt: skip


def _end(child: subprocess.Popen[bytes]) -> None:
    """End a child process and its children; nothing where it has ended by itself."""
    if child.poll() is None:
        try:
            os.killpg(child.pid, signal.SIGKILL)
        except ProcessLookupError:  # it has not got so far as to have a group of its own
            child.kill()
        child.wait()
    if child.stdin is None:  # else its own thread reads it
        _close(child.stdout)


def _close(pipe: object) -> None:
    try:
        pipe.close()  # type: ignore[attr-defined]
    except OSError:
        pass  # what was buffered for a child that is gone
