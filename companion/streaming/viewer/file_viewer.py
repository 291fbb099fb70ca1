"""Viewer file of a flight, written by a thread of its own."""

from __future__ import annotations

import os
import threading
from pathlib import Path

from companion.config import ViewerConfig
from companion.geometry.camera import Camera
from companion.geometry.geodesy import GeoOrigin
from companion.runtime.mailbox import DropPolicy, Mailbox
from companion.runtime.message_size import size_bytes
from companion.streaming.frame_jpeg import picture_of
from companion.streaming.items import FlightItem, ImageItem, Item
from companion.streaming.scene_encoder import SceneEncoder, Watched
from companion.streaming.viewer.colours import Colours
from companion.streaming.viewer.drawing import Drawing
from companion.streaming.viewer.rrd_files import RrdFiles

CAPACITY_BYTES = 64 << 20
GATHER_S = 0.1
"""Messages gather for this long: nobody waits for the file."""
NICE = 5
"""Of its thread, which in Linux has a priority of its own: what is shown waits for the path."""


class FileViewer:
    """Writer of all messages into a .rrd file; the caller waits where it cannot keep up.

    At most `rrd_mb` of the newest are kept, in several files. An error of the thread is raised when
    the file is closed, and not before. `indexed` is not for long flights, see RrdFiles.
    """

    def __init__(
        self, config: ViewerConfig, camera: Camera, path: Path, origin: GeoOrigin | None = None,
        indexed: bool = True,
    ) -> None:  # fmt: skip
        self._files = RrdFiles(path, config.rrd_mb << 20, indexed)
        self._config = config
        self._encoder = SceneEncoder(FlightItem(path.parent.name, path.parent.name, camera, origin))
        self._waiting: Mailbox[Watched] = Mailbox(
            lambda _: DropPolicy.LOSSLESS, size_bytes, CAPACITY_BYTES, waits=True
        )
        self._fault: BaseException | None = None
        self._thread = threading.Thread(target=self._work, name="recording", daemon=True)

    def take(self, message: Watched) -> None:
        """Queue one message."""
        self._waiting.put(message)

    def __enter__(self) -> FileViewer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._waiting.close()
        self._thread.join()
        try:
            self._files.close()
        finally:
            if self._fault is not None:
                raise self._fault

    def _work(self) -> None:
        os.nice(NICE)
        try:
            colours = Colours(self._config.colours)
            drawing = Drawing(self._files.recording, live=False, colours=colours)
            drawing.draw(self._encoder.flight)
            while messages := self._waiting.collect(CAPACITY_BYTES // 8, GATHER_S):
                for message in messages:
                    self._draw(drawing, self._encoder.take(message))
            self._draw(drawing, self._encoder.close())
        except BaseException as fault:
            self._fault = fault
            self._waiting.close()

    def _draw(self, drawing: Drawing, items: list[Item]) -> None:
        for item in items:
            if isinstance(item, ImageItem):
                width, quality = self._config.image_width, self._config.jpeg_quality
                item = picture_of(item, width, quality)
            drawing.draw(item)
            if self._files.is_full(size_bytes(item)):
                drawing.go_on_in(self._files.next())
