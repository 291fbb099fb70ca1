"""Where a scene goes: a file, or a live viewer that must not stall the flight.

Each has its own thread. The file's queue makes the caller wait, since a recording is complete; a
live viewer's queue gives up what it has no room for, and counts it.
"""

from __future__ import annotations

import queue
import threading
from pathlib import Path
from types import TracebackType

import rerun as rr

from companion.camera import Camera
from companion.config import ViewerConfig
from companion.messages import Frame, Message
from companion.viewer.layout import layout
from companion.viewer.scene import Scene

APPLICATION = "companion"
ROOM = 400
PATIENCE_S = 3.0
WEB_PORT = 9090
GRPC_PORT = 9876


class _Viewer:
    """A scene in its own thread, fed through a bounded queue."""

    def __init__(self, config: ViewerConfig, camera: Camera, lossless: bool) -> None:
        self._recording = rr.RecordingStream(APPLICATION)
        self._lossless = lossless
        self._inbox: queue.Queue[Message | None] = queue.Queue(ROOM)
        self._config, self._camera = config, camera
        self._fault: BaseException | None = None
        self._thread = threading.Thread(target=self._work, name="viewer", daemon=True)
        self.n_dropped = 0

    def take(self, message: Message) -> None:
        """Queue one message."""
        if self._lossless:
            self._inbox.put(message)
            return
        # half the room is kept for what is small
        if isinstance(message, Frame) and self._inbox.qsize() > ROOM // 2:
            self.n_dropped += 1
            return
        try:
            self._inbox.put_nowait(message)
        except queue.Full:
            self.n_dropped += 1

    def __enter__(self) -> _Viewer:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._lossless:
            self._inbox.put(None)
            self._thread.join()
            self._recording.disconnect()
            if self._fault is not None:
                raise self._fault
            return
        try:
            self._inbox.put_nowait(None)
        except queue.Full:
            return  # the viewer hangs: its thread is left to die with the process
        self._thread.join(PATIENCE_S)

    def _work(self) -> None:
        try:
            scene = Scene(self._recording, self._config, self._camera)
            while (message := self._inbox.get()) is not None:
                scene.take(message)
        except BaseException as fault:  # raised where the sink is closed
            self._fault = fault
            while self._inbox.get() is not None:
                pass


class FileViewer(_Viewer):
    """Everything, into a .rrd file."""

    def __init__(self, config: ViewerConfig, camera: Camera, path: Path) -> None:
        super().__init__(config, camera, lossless=True)
        self._recording.save(path, default_blueprint=layout())


class LiveViewer(_Viewer):
    """A viewer that is looked at now: `web`, `native`, or the rerun+http address of one that runs.

    Servers listen on the loopback address only.
    """

    def __init__(self, config: ViewerConfig, camera: Camera, where: str) -> None:
        super().__init__(config, camera, lossless=False)
        if where == "web":
            self._recording.set_sinks(
                rr.GrpcServerSink(bind_ip="127.0.0.1", port=GRPC_PORT), default_blueprint=layout()
            )
            address = f"rerun+http://127.0.0.1:{GRPC_PORT}/proxy"
            rr.serve_web_viewer(web_port=WEB_PORT, open_browser=False, connect_to=address)
        elif where == "native":
            self._recording.spawn(port=GRPC_PORT, default_blueprint=layout())
        else:
            self._recording.connect_grpc(where, default_blueprint=layout())
