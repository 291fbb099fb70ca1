"""The viewer of a flight: opened when it can be reached, and again when it has gone.

Whoever calls `take` never waits, and nothing that becomes of a viewer matters to the flight.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from companion.camera import Camera
from companion.config import Config
from companion.errors import InputError
from companion.messages import Frame, Message
from companion.viewer import LiveViewer

LOOK_S = 0.5
AGAIN_S = 3.0
"""Between two attempts to reach a viewer."""
PATIENCE_S, HURRIED_S = 3.0, 0.2
"""What a viewer may take to show the last of a flight."""
MANY = 50
"""So many messages given up between two looks are a viewer that hangs, or a slow link to it."""
NO_VIEWER = "the viewer cannot be shown"
GONE = "the viewer has gone"
BEHIND = "the viewer does not keep up"


class Viewing:
    """Keeps `daemon.viewer` shown in a thread of its own until `close`."""

    def __init__(self, config: Config, camera: Camera, warn: Callable[[str, str], None]) -> None:
        self._config, self._camera, self._warn = config, camera, warn
        self.pictures = True
        """Whether it is given pictures."""
        self._n_dropped = 0
        self._viewer: LiveViewer | None = None
        self._told = ""
        self._over = threading.Event()
        self._patience_s = PATIENCE_S
        self._thread = threading.Thread(target=self._run, name="viewing", daemon=True)
        self._thread.start()

    @property
    def n_dropped(self) -> int:
        """Messages that there was no room for, or no viewer."""
        viewer = self._viewer
        return self._n_dropped + (viewer.n_dropped if viewer is not None else 0)

    def take(self, message: Message) -> None:
        """Show a message, or drop it."""
        viewer = self._viewer
        if not self.pictures and isinstance(message, Frame):
            return
        if viewer is not None:
            viewer.take(message)
        else:
            self._n_dropped += 1

    def close(self, hurry: bool) -> None:
        """The flight is over; what the viewer has not shown by then it never will."""
        self._patience_s = HURRIED_S if hurry else PATIENCE_S
        self._over.set()
        self._thread.join(3 * self._patience_s)

    def _run(self) -> None:
        wait_s = 0.0
        while not self._over.wait(wait_s):
            wait_s = AGAIN_S
            where = self._config.daemon.viewer
            try:
                viewer = LiveViewer(self._config.viewer, self._camera, where)
            except InputError as error:
                self._tell(NO_VIEWER, str(error))
                continue
            viewer.start()
            self._viewer, self._told = viewer, ""
            self._watch(viewer)
            self._viewer = None
            viewer.close(self._patience_s if self._over.is_set() else HURRIED_S)
            self._n_dropped += viewer.n_dropped
            if where == "native" and not self._over.is_set():
                return  # its window was closed by whoever looked at it

    def _watch(self, viewer: LiveViewer) -> None:
        """Until it has gone or the flight is over."""
        n_dropped = 0
        while not self._over.wait(LOOK_S):
            if not viewer.alive:
                self._tell(GONE, self._config.daemon.viewer)
                return
            if viewer.n_dropped - n_dropped > MANY:
                self._tell(BEHIND, f"{viewer.n_dropped} messages were not shown")
            n_dropped = viewer.n_dropped

    def _tell(self, what: str, detail: str) -> None:
        """Say it, but not again as long as nothing else is to be said."""
        if what != self._told:
            self._told = what
            self._warn(what, detail)
