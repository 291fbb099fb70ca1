"""Raw video with exact stamps by TCP: NUT, as one client at a time gets it.

A picture is handed over when it is due, or left out where the client has not taken the one before.
"""

from __future__ import annotations

import contextlib
import fcntl
import queue
import socket
import struct
import termios
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import av
import cv2
import numpy as np

from companion.messages import Bytes

WAITING = 64
"""Pictures that may wait until they are due, of a third of a megabyte to one each."""
SEND_S = 0.5
"""A client that takes part of a picture, and not the rest within this time, is cut off."""
MICROSECONDS = Fraction(1, 1_000_000)


@dataclass(frozen=True, slots=True, eq=False)
class Due:
    """A picture (H, W, 3) RGB, its exposure (Unix time), and when it is handed over."""

    seq: int
    picture: Bytes
    exposure_s: float
    due_s: float


class PictureServer:
    """See above. `sent` is called with each picture, how late it is, and whether it was taken.

    Pictures are handed over in their order: none overtakes one whose latency is longer.
    """

    def __init__(self, port: int, rate_hz: float, sent: Callable[[Due, float, bool], None]) -> None:
        self._rate_hz, self._sent = rate_hz, sent
        self._door: socket.socket | None = None
        self._port = port
        self._client: _Client | None = None
        self._waiting: queue.Queue[Due | None] = queue.Queue(WAITING)
        self._stop = threading.Event()
        self._lock = threading.Lock()
        self.open_door()
        self._threads = [
            threading.Thread(target=each, name=f"pictures: {each.__name__}", daemon=True)
            for each in (self._accept, self._hand_over)
        ]
        for thread in self._threads:
            thread.start()

    @property
    def url(self) -> str:
        """Address for the client."""
        return f"tcp://127.0.0.1:{self._port}"

    def give(self, due: Due) -> None:
        """Have a picture handed over."""
        try:
            self._waiting.put_nowait(due)
        except queue.Full:
            self._sent(due, 0.0, False)

    def open_door(self) -> None:
        """Let clients in again."""
        with self._lock:
            if self._door is None:
                self._door = socket.create_server(("127.0.0.1", self._port))
                self._door.settimeout(0.05)
                self._port = int(self._door.getsockname()[1])

    def shut_door(self) -> None:
        """Cut off the client, and refuse others."""
        with self._lock:
            door, self._door = self._door, None
            client, self._client = self._client, None
        if door is not None:
            door.close()
        if client is not None:
            client.cut()

    def close(self) -> None:
        """End."""
        self._stop.set()
        self.shut_door()
        with contextlib.suppress(queue.Full):
            self._waiting.put_nowait(None)
        for thread in self._threads:
            thread.join(2 * SEND_S)

    def _accept(self) -> None:
        while not self._stop.is_set():
            door = self._door
            if door is None:
                self._stop.wait(0.02)
                continue
            try:
                wire, _ = door.accept()
            except OSError:  # nobody in this time, or the door was shut
                continue
            with self._lock:
                if self._door is None:
                    wire.close()
                    continue
                # whoever connects anew has given the old connection up
                old, self._client = self._client, _Client(wire, self._rate_hz)
            if old is not None:
                old.cut()

    def _hand_over(self) -> None:
        while not self._stop.is_set():
            due = self._waiting.get()
            if due is None:
                return
            if self._stop.wait(max(0.0, due.due_s - time.time())):
                return  # it is not due yet
            client, taken = self._client, False
            late_s = time.time() - due.due_s
            if client is not None:
                try:
                    taken = client.take(due.picture, round(due.exposure_s * 1e6))
                except (OSError, av.FFmpegError):
                    client.cut()
                    with self._lock:
                        if self._client is client:
                            self._client = None
            self._sent(due, late_s, taken)


class _Client:
    def __init__(self, wire: socket.socket, rate_hz: float) -> None:
        wire.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        wire.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 20)
        wire.settimeout(SEND_S)
        self._wire, self._rate_hz = wire, rate_hz
        self._box: Any = None
        self._stream: Any = None

    def write(self, data: bytes) -> int:
        """All of it, for the muxer."""
        self._wire.sendall(data)
        return len(data)

    def take(self, picture: Bytes, stamp_us: int) -> bool:
        """Send a picture, unless much of the last is still under way."""
        height, width = picture.shape[:2]
        if self._unsent() > width * height // 2:
            return False
        if self._box is None:
            self._box = av.open(self, "w", format="nut", options={"flush_packets": "1"})
            self._stream = self._box.add_stream("rawvideo", rate=round(self._rate_hz))
            self._stream.width, self._stream.height = width, height
            self._stream.pix_fmt = "yuv420p"
            self._stream.time_base = self._stream.codec_context.time_base = MICROSECONDS
        planes = np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2YUV_I420), np.uint8)
        frame = av.VideoFrame.from_ndarray(planes, format="yuv420p")
        frame.pts, frame.time_base = stamp_us, MICROSECONDS
        for packet in self._stream.encode(frame):
            self._box.mux(packet)
        return True

    def cut(self) -> None:
        with contextlib.suppress(OSError):
            self._wire.shutdown(socket.SHUT_RDWR)
        self._wire.close()

    def _unsent(self) -> int:
        """Bytes that the client's computer has not taken."""
        state = fcntl.ioctl(self._wire.fileno(), termios.TIOCOUTQ, bytes(4))
        return int(struct.unpack("i", state)[0])
