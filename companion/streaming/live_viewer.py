"""Live viewers of a flight: stage `viewers` in its process, and a viewer on board.

Links and viewers are served there. No failure of theirs makes the caller wait.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from companion.config import Config, StreamConfig, ViewerConfig
from companion.errors import InputError
from companion.geometry.camera import Camera
from companion.geometry.geodesy import GeoOrigin
from companion.messages import Frame
from companion.runtime.parcel import Parcel
from companion.runtime.stage_process import StageProcess
from companion.runtime.stage_protocol import Finish, Listening, SetBudget, Setup
from companion.runtime.stages import stage_named
from companion.streaming.scene_encoder import Watched

PATIENCE_S = 3.0
START_S = 30.0
READY = b"ready"
"""Prefix of the line in which the viewer process reports its address for browsers."""
GROUND = "companion.streaming.viewer.ground_process"
NOWHERE = "none"
ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
FRAME_EVERY_NS = 60_000_000
"""Least interval of frames for viewers."""
STAGE = stage_named("viewers")
SHOWN = {kind.__name__ for kind in STAGE.listens}


class LiveViewer:
    """Exports a flight to viewers that connect to `stream.listen`; `look` opens one here, too.

    Messages beyond the capacity are dropped and counted. `where` is as for `look`.
    """

    def __init__(
        self, config: ViewerConfig, camera: Camera, where: str = NOWHERE, name: str = "",
        stream: StreamConfig | None = None, origin: GeoOrigin | None = None,
    ) -> None:  # fmt: skip
        self.page = ""
        """Address for a browser; "" for a window."""
        self._colours = config.colours
        self._stream = stream or StreamConfig(listen="")
        self._port = 0
        self._frame_ns = -(2**63)
        self._has_port = threading.Event()
        self._ground: subprocess.Popen[bytes] | None = None
        self._stage = StageProcess(STAGE, self._take_port, lambda why: self._has_port.set())
        settings = replace(Config(), viewer=config, stream=self._stream)
        self._stage.begin(Setup(settings, camera, Path(name) if name else None, origin=origin))
        if where != NOWHERE:
            try:
                self.look(where)
            except BaseException:
                self.close(0.0)
                raise

    def take(self, message: Watched) -> None:
        """Show one message, or drop it; of those that cannot be shown nothing comes."""
        if type(message).__name__ in SHOWN:
            self.offer(Parcel.of(message))

    def offer(self, parcel: Parcel) -> None:
        """The same with a closed message."""
        if parcel.kind == Frame.__name__:
            if parcel.t_ns - self._frame_ns < FRAME_EVERY_NS:
                return
            self._frame_ns = parcel.t_ns
        if parcel.kind in SHOWN:
            self._stage.offer(parcel)

    @property
    def n_dropped(self) -> int:
        """Messages dropped for lack of capacity."""
        return self._stage.n_dropped

    @property
    def report(self) -> Mapping[str, Any]:
        """Last report of the exporter."""
        progress = self._stage.progress
        return progress.details if progress is not None else {}

    @property
    def closed(self) -> str:
        """Reason why nobody can connect, or ""."""
        return str(self.report.get("closed", ""))

    def set_budget(self, kbit_s: float) -> None:
        """Limit the rate of all viewers together; 0 for no limit."""
        self._stage.order(SetBudget(kbit_s))

    def look(self, where: str) -> None:
        """Open a viewer: `web`, `native`, or the rerun+http address of one that runs.

        Raises InputError where no viewer can be reached or started.
        """
        if not self._has_port.wait(START_S) or not self._port:
            raise InputError(f"--viewer {where}: the exporter ended as it began")
        child = _child(where, str(self._port), self._colours, self._stream.web_bind)
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
        return self._stage.pid

    @property
    def alive(self) -> bool:
        """True while the exporter runs."""
        return self._stage.alive

    def stalled_s(self, now_s: float) -> float:
        """Seconds for which the exporter has not done anything; 0 where nothing waits."""
        return self._stage.stalled_s(now_s)

    def interrupt(self) -> None:
        """End an exporter that hangs, as if it had died by itself."""
        self._stage.interrupt()

    @property
    def is_shown(self) -> bool:
        """True while the viewer that was started here runs."""
        return self._ground is not None and self._ground.poll() is None

    def __enter__(self) -> LiveViewer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close(PATIENCE_S)

    def close(self, patience_s: float) -> None:
        """Send what is queued, and end; each in the time given."""
        self._stage.ask_to_finish(Finish(patience_s < PATIENCE_S, n_viewers=int(self.is_shown)))
        self._stage.wait(2 * patience_s)
        self._stage.kill()
        if self._ground is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._ground.wait(patience_s)  # it ends by itself once it has shown all
            _end(self._ground)

    def _take_port(self, parcel: Parcel) -> None:
        told = parcel.open()
        if isinstance(told, Listening):
            self._port = told.port
            self._has_port.set()


def _child(*arguments: str) -> subprocess.Popen[bytes]:
    environment = {**dict.fromkeys(ONE_THREAD, "1"), **os.environ}
    return subprocess.Popen(
        [sys.executable, "-m", GROUND, *arguments], env=environment,
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
    )  # fmt: skip


def _end(child: subprocess.Popen[bytes]) -> None:
    """End a child process and its children; nothing where it has ended by itself."""
    if child.poll() is None:
        try:
            os.killpg(child.pid, signal.SIGKILL)
        except ProcessLookupError:  # it has not got so far as to have a group of its own
            child.kill()
        child.wait()
    assert child.stdout is not None
    child.stdout.close()
