"""Viewers of a flight whose map is made here: the exporter, supervised, and the viewer on board."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from companion.config import Config
from companion.daemon.flights.viewing import VIEWERS, Viewing
from companion.geometry.camera import Camera
from companion.messages import Message
from companion.runtime.in_processes import InProcesses, Supervisor
from companion.runtime.parcel import Parcel
from companion.runtime.stage_protocol import Finish, Listening, Setup
from companion.runtime.stage_start import start_alone
from companion.runtime.stages import Stage, stage_named


class RemoteViewing:
    """Shows messages to viewers; `warn` is as for Viewing."""

    def __init__(
        self, config: Config, camera: Camera, flight: str, warn: Callable[[str, str, bool], None]
    ) -> None:
        def setup(stage: Stage, n_restarted: int, failed_devices: dict[str, str]) -> Setup:
            return Setup(config, camera, Path(flight))

        row = stage_named(VIEWERS)
        self._listens = row.listens
        self._processes = InProcesses(
            [row],
            start_alone,
            Supervisor(setup, self._hear, self._say_restarted, lambda why: None, lambda why: None),
        )
        self._processes.start()  # the exporter itself begins with the flight, and is heard then
        self._viewing = Viewing(config, lambda: self._processes.by_name[VIEWERS], warn)
        self._processes.fly()

    def take(self, message: Message) -> None:
        """Show a message, or drop it; never waits."""
        if isinstance(message, self._listens):
            self._processes.publish(Parcel.of(message))

    def step(self) -> None:
        """Have an exporter that hangs started again; to be called often."""
        self._processes.end_stalled()

    def close(self, hurry: bool) -> None:
        """End; data that viewers lack by then is lost."""
        if hurry:
            self._processes.hurry()
        self._viewing.open_no_more()
        shown = int(self._viewing.is_shown)
        self._processes.finish(lambda stage: Finish(hurry, n_viewers=shown))
        self._viewing.close(hurry)

    def _hear(self, parcel: Parcel) -> None:
        if parcel.kind == Listening.__name__:
            self._viewing.take_port(parcel.open().port)

    def _say_restarted(self, stage: Stage, why: str) -> None:
        self._viewing.stage_gone(why)
