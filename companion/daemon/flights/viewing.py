"""The viewers of a flight: its exporter, and the viewer on board if one is configured.

`take` never waits, and no failure of a viewer affects the flight.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace

from companion.config import Config
from companion.errors import InputError
from companion.geometry.camera import Camera
from companion.health import StageHealth
from companion.messages import Frame
from companion.runtime.parcel import Parcel
from companion.streaming.live_viewer import LiveViewer
from companion.streaming.scene_encoder import Watched
from companion.timing.clock import monotonic_s

LOOK_S = 0.5
AGAIN_S = 3.0
"""Pause between two attempts to open the viewer."""
PATIENCE_S, HURRIED_S = 3.0, 0.2
"""Time for a viewer to show the last messages of a flight."""
STALLED_S = 30.0
"""An exporter that reads nothing for this long is restarted."""
MANY = 50
"""Messages dropped between two checks that mean an exporter that hangs."""
NOWHERE = "none"
SHOWN = "the flight can be seen"
NO_VIEWER = "the viewer cannot be shown"
GONE = "the viewer has gone"
BEHIND = "the viewer does not keep up"
CLOSED = "viewers cannot connect"


class Viewing:
    """Exports to `stream.listen` and keeps `daemon.viewer` open until `close`.

    `warn` takes a warning, its detail, and whether it is good news.
    """

    def __init__(
        self, config: Config, camera: Camera, name: str, warn: Callable[[str, str, bool], None]
    ) -> None:
        self._config, self._camera, self._name, self._warn = config, camera, name, warn
        self._stream = config.stream
        self.pictures = True
        """True while images are sent to viewers."""
        self._n_dropped = self._n_seen = self._n_restarted = 0
        self._where = config.daemon.viewer
        self._last_warning = ""
        self._was_shown = False
        self._over = threading.Event()
        self._patience_s = PATIENCE_S
        self._viewer = self._open()
        self._thread = threading.Thread(target=self._run, name="viewing", daemon=True)
        self._thread.start()

    @property
    def n_dropped(self) -> int:
        """Messages dropped for lack of capacity."""
        return self._n_dropped + self._viewer.n_dropped

    @property
    def pid(self) -> int:
        """Process id of the exporter."""
        return self._viewer.pid

    def health(self) -> StageHealth:
        """Health of the exporter; data that it skipped on thin links counts as dropped."""
        report = self._viewer.report
        n_viewers = int(report.get("viewers", 0))
        plural = "" if n_viewers == 1 else "s"
        detail = f"{n_viewers} viewer{plural}"
        if n_viewers:
            detail += f", {report['kbit_s']:.0f} kbit/s"
        if report.get("budget_kbit_s"):
            detail += f", budget {report['budget_kbit_s']:.0f} kbit/s"
        if self._viewer.closed:
            detail += f"; closed: {self._viewer.closed}"
        return StageHealth(
            "viewers", alive=self._viewer.alive, detail=detail,
            n_dropped=self.n_dropped + int(report.get("skipped", 0)),
            n_restarted=self._n_restarted,
        )  # fmt: skip

    def take(self, message: Watched) -> None:
        """Show a message, or drop it."""
        if self.pictures or not isinstance(message, Frame):
            self._viewer.take(message)

    def offer(self, parcel: Parcel) -> None:
        """The same with a closed message."""
        if self.pictures or parcel.kind != Frame.__name__:
            self._viewer.offer(parcel)

    def set_budget(self, kbit_s: float) -> None:
        """Limit the rate of all viewers together; 0 for no limit."""
        self._stream = replace(self._stream, budget_kbit_s=kbit_s)
        self._viewer.set_budget(kbit_s)

    def close(self, hurry: bool) -> None:
        """End at the end of the flight; data that viewers lack by then is lost."""
        self._patience_s = HURRIED_S if hurry else PATIENCE_S
        self._over.set()
        self._thread.join(4 * self._patience_s + 1.0)

    def _open(self) -> LiveViewer:
        return LiveViewer(self._config.viewer, self._camera, name=self._name, stream=self._stream)

    def _run(self) -> None:
        wait_s = 0.0
        while not self._over.wait(wait_s):
            wait_s = LOOK_S
            if not self._viewer.alive:
                self._tell(GONE, "its exporter has ended")
                self._n_restarted += 1
                self._viewer.close(HURRIED_S)
                self._n_dropped += self._viewer.n_dropped
                self._viewer = self._open()
                wait_s = AGAIN_S
            elif self._viewer.stalled_s(monotonic_s()) > STALLED_S:
                self._viewer.interrupt()
                wait_s = 0.0
            elif self._where != NOWHERE and not self._viewer.is_shown:
                wait_s = self._show()
            self._look()
        self._viewer.close(self._patience_s)

    def _show(self) -> float:
        """Open the viewer, for the first time or again; seconds until the next attempt."""
        if self._last_warning == "" and self._was_shown:
            self._tell(GONE, self._where)
            if self._where == "native":
                self._where = NOWHERE  # its window was closed by whoever looked at it
                return LOOK_S
        try:
            self._viewer.look(self._where)
        except InputError as error:
            self._tell(NO_VIEWER, str(error))
            return AGAIN_S
        self._was_shown, self._last_warning = True, ""
        if self._viewer.page:
            self._warn(SHOWN, f"open {self._viewer.page}", True)
        return LOOK_S

    def _look(self) -> None:
        n_dropped = self._viewer.n_dropped
        if n_dropped - self._n_seen > MANY:
            self._tell(BEHIND, f"{n_dropped} messages were not shown")
        self._n_seen = n_dropped
        if self._viewer.closed:
            self._tell(CLOSED, self._viewer.closed)

    def _tell(self, what: str, detail: str) -> None:
        """Warn, unless the same was the last warning."""
        if what != self._last_warning:
            self._last_warning = what
            self._warn(what, detail, False)
