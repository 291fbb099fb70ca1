"""Reports on the viewers of a flight, and the viewer on board if one is configured.

Their exporter is a stage like the others; no failure of a viewer affects the flight.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Any

from companion.config import Config
from companion.errors import InputError
from companion.runtime.stage_process import StageProcess
from companion.streaming.onboard_viewer import OnboardViewer

VIEWERS = "viewers"
"""The stage that exports."""
LOOK_S = 0.5
AGAIN_S = 3.0
"""Pause between two attempts to open the viewer."""
PATIENCE_S, HURRIED_S = 3.0, 0.2
"""Time for a viewer to show the last messages of a flight."""
MANY = 50
"""Messages dropped between two checks that mean an exporter that hangs."""
NOWHERE = "none"
SHOWN = "the flight can be seen"
NO_VIEWER = "the viewer cannot be shown"
GONE = "the viewer has gone"
BEHIND = "the viewer does not keep up"
CLOSED = "viewers cannot connect"


class Viewing:
    """Keeps `daemon.viewer` open until `close`, and warns of what viewers lack.

    `stage` gives the exporter, which may have been started again; `warn` takes a warning, its
    detail, and whether it is good news.
    """

    def __init__(
        self, config: Config, stage: Callable[[], StageProcess],
        warn: Callable[[str, str, bool], None],
    ) -> None:  # fmt: skip
        self._config, self._stage, self._warn = config, stage, warn
        self._where = config.daemon.viewer
        self._n_seen = 0
        self._port, self._onboard_port = 0, 0
        """Of the exporter for viewers of this machine; of the one that the viewer looks at."""
        self._onboard: OnboardViewer | None = None
        self._last_warning = ""
        self._opens = True
        self._over = threading.Event()
        self._patience_s = PATIENCE_S
        self._thread = threading.Thread(target=self._run, name="viewing", daemon=True)
        self._thread.start()

    @property
    def is_shown(self) -> bool:
        """True while a viewer on board is open."""
        return self._onboard is not None and self._onboard.is_shown

    @property
    def n_skipped(self) -> int:
        """Data that the exporter skipped on thin links."""
        return int(self._report.get("skipped", 0))

    @property
    def detail(self) -> str:
        """Viewers that there are, and their rate, in words."""
        report = self._report
        n_viewers = int(report.get("viewers", 0))
        plural = "" if n_viewers == 1 else "s"
        detail = f"{n_viewers} viewer{plural}"
        if n_viewers:
            detail += f", {report['kbit_s']:.0f} kbit/s"
        if report.get("budget_kbit_s"):
            detail += f", budget {report['budget_kbit_s']:.0f} kbit/s"
        if report.get("closed"):
            detail += f"; closed: {report['closed']}"
        return detail

    @property
    def port(self) -> int:
        """Port of the exporter for viewers of this machine; 0 before it has told."""
        return self._port

    def take_port(self, port: int) -> None:
        """Take the port where an exporter that has just started serves viewers here."""
        self._port = port

    def stage_gone(self, why: str) -> None:
        """Take that the exporter has ended, and why; another is started."""
        self._tell(GONE, f"its exporter has ended: {why}")

    def open_no_more(self) -> None:
        """Take that the flight ends: a viewer that has ended with its exporter is not missed."""
        self._opens = False

    def close(self, hurry: bool) -> None:
        """End at the end of the flight; data that viewers lack by then is lost."""
        self._patience_s = HURRIED_S if hurry else PATIENCE_S
        self._over.set()
        self._thread.join(2 * self._patience_s + 1.0)

    @property
    def _report(self) -> Mapping[str, Any]:
        progress = self._stage().progress
        return progress.details if progress is not None else {}

    def _run(self) -> None:
        wait_s = 0.0
        while not self._over.wait(wait_s):
            wait_s = LOOK_S
            is_old = self._onboard_port != self._port
            wanted = self._opens and self._where != NOWHERE and self._port
            if wanted and (is_old or not self.is_shown):
                wait_s = self._show()
            self._look()
        if self._onboard is not None:
            self._onboard.close(self._patience_s)

    def _show(self) -> float:
        """Open the viewer, for the first time or again; seconds until the next attempt."""
        if self._onboard is not None:
            was_closed = self._onboard_port == self._port
            self._onboard.close(0.0)
            self._onboard = None
            if was_closed:
                self._tell(GONE, self._where)
                if self._where == "native":
                    self._where = NOWHERE  # its window was closed by whoever looked at it
                    return LOOK_S
        self._onboard_port = self._port
        try:
            self._onboard = OnboardViewer(
                self._where, self._port, self._config.viewer.colours, self._config.stream.web_bind
            )
        except (InputError, OSError) as error:
            self._tell(NO_VIEWER, str(error))
            return AGAIN_S
        self._last_warning = ""
        if self._onboard.page:
            self._warn(SHOWN, f"open {self._onboard.page}", True)
        return LOOK_S

    def _look(self) -> None:
        n_dropped, closed = self._stage().n_dropped, str(self._report.get("closed", ""))
        if n_dropped - self._n_seen > MANY:
            self._tell(BEHIND, f"{n_dropped} messages were not shown")
        self._n_seen = n_dropped
        if closed:
            self._tell(CLOSED, closed)

    def _tell(self, what: str, detail: str) -> None:
        """Warn, unless the same was the last warning."""
        if what != self._last_warning:
            self._last_warning = what
            self._warn(what, detail, False)
