"""Live viewer of a replay: stage `viewers` in its process, and a viewer on board.

No failure of theirs makes the caller wait.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any

from companion.config import Config, StreamConfig, ViewerConfig
from companion.errors import InputError
from companion.geometry.camera import Camera
from companion.geometry.geodesy import GeoOrigin
from companion.runtime.parcel import Parcel
from companion.runtime.stage_process import StageProcess
from companion.runtime.stage_protocol import Finish, Listening, Setup
from companion.runtime.stage_start import start_alone
from companion.runtime.stages import stage_named
from companion.streaming.onboard_viewer import OnboardViewer
from companion.streaming.scene_encoder import Watched

PATIENCE_S = 3.0
START_S = 30.0
NOWHERE = "none"
STAGE = stage_named("viewers")


class LiveViewer:
    """Exports to viewers that connect to `stream.listen`, and opens one here, `where` wanted.

    Messages beyond the capacity are dropped and counted. Raises InputError where no viewer can be
    reached or started; `where` is as for OnboardViewer, "none" for none.
    """

    def __init__(
        self, config: ViewerConfig, camera: Camera, where: str = NOWHERE, name: str = "",
        stream: StreamConfig | None = None, origin: GeoOrigin | None = None,
    ) -> None:  # fmt: skip
        stream = stream or StreamConfig(listen="")
        self._port = 0
        self._has_port = threading.Event()
        self.onboard: OnboardViewer | None = None
        """The viewer on board; None without one."""
        self.stage = StageProcess(
            STAGE, start_alone, self._take_port, lambda why: self._has_port.set()
        )
        """The exporter."""
        settings = replace(Config(), viewer=config, stream=stream)
        self.stage.begin(Setup(settings, camera, Path(name) if name else None, origin=origin))
        if where != NOWHERE:
            try:
                if not self._has_port.wait(START_S) or not self._port:
                    raise InputError(f"--viewer {where}: the exporter ended as it began")
                self.onboard = OnboardViewer(where, self._port, config.colours, stream.web_bind)
            except BaseException:
                self.close(0.0)
                raise

    @property
    def page(self) -> str:
        """Address for a browser; "" for a window, or no viewer."""
        return self.onboard.page if self.onboard is not None else ""

    def take(self, message: Watched) -> None:
        """Show one message, or drop it; of those that cannot be shown nothing comes."""
        if isinstance(message, STAGE.listens):
            self.stage.offer(Parcel.of(message))

    @property
    def n_dropped(self) -> int:
        """Messages dropped for lack of capacity."""
        return self.stage.n_dropped

    @property
    def report(self) -> Mapping[str, Any]:
        """Last report of the exporter."""
        progress = self.stage.progress
        return progress.details if progress is not None else {}

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
        is_shown = self.onboard is not None and self.onboard.is_shown
        self.stage.ask_to_finish(Finish(patience_s < PATIENCE_S, n_viewers=int(is_shown)))
        self.stage.wait(2 * patience_s)
        self.stage.kill()
        if self.onboard is not None:
            self.onboard.close(patience_s)

    def _take_port(self, parcel: Parcel) -> None:
        told = parcel.open()
        if isinstance(told, Listening):
            self._port = told.port
            self._has_port.set()
