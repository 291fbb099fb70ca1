"""A scene that goes to a file, written by its own thread."""

from __future__ import annotations

import threading
from pathlib import Path
from types import TracebackType

import rerun as rr

from companion.camera import Camera
from companion.config import ViewerConfig
from companion.messages import Message
from companion.viewer.inbox import Inbox
from companion.viewer.layout import layout
from companion.viewer.scene import APPLICATION, Scene

ROOM_BYTES = 64 << 20


class FileViewer:
    """Everything, into a .rrd file: the caller waits when the file cannot keep up.

    What goes wrong in the thread is raised when the file is closed, and not before.
    """

    def __init__(self, config: ViewerConfig, camera: Camera, path: Path) -> None:
        self._recording = rr.RecordingStream(APPLICATION)
        self._recording.save(path, default_blueprint=layout())
        self._config, self._camera = config, camera
        self._inbox = Inbox(ROOM_BYTES)
        self._fault: BaseException | None = None
        self._thread = threading.Thread(target=self._work, name="recording", daemon=True)

    def take(self, message: Message) -> None:
        """Queue one message."""
        self._inbox.put(message)

    def __enter__(self) -> FileViewer:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._inbox.close()
        self._thread.join()
        self._recording.disconnect()
        if self._fault is not None:
            raise self._fault

    def _work(self) -> None:
        try:
            scene = Scene(self._recording, self._config, self._camera)
            while (message := self._inbox.get()) is not None:
                scene.take(message)
            scene.close()
        except BaseException as fault:
            self._fault = fault
            self._inbox.close()
