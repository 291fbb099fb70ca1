"""RTSP and other network video by PyAV (FFmpeg): the newest image, decoded as it arrives."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

import av
import av.error
import cv2
import numpy as np

from companion.config import CameraConfig
from companion.errors import ConfigError, SourceError
from companion.messages import Bytes
from drivers.camera.arrival_clock import ArrivalClock
from drivers.camera.camera_source import EndOfPictures, Picture

OPEN_S = 4.0
"""Timeout to connect and to analyse the stream."""
READ_S = 2.0
"""Time without a packet after which the connection counts as lost."""
MAX_WAIT_FOR_ORDER_US = 100_000
"""Reordering window of UDP packets."""
NO_STAMPS = 0x80
"""AVFMT_NOTIMESTAMPS: the stream has none (JPEG over HTTP), and FFmpeg makes them up."""
BRIGHTNESS_FIRST = frozenset({"yuv420p", "yuvj420p", "yuv422p", "yuvj422p", "nv12", "gray"})
"""Pixel formats whose first plane is the grey image."""


@dataclass(slots=True)
class _Newest:
    frame: av.VideoFrame
    monotonic_ns: int


class NetworkCamera:
    """Video stream; images that it cannot decode in time are dropped, never queued."""

    live = True
    start_s = 8.0
    """Time to the first intra picture: some cameras send one every few seconds."""
    silent_s = 2.0

    def __init__(self, config: CameraConfig) -> None:
        self.name = without_secrets(config.url)
        if urlsplit(config.url).scheme in ("", "file"):
            raise ConfigError(
                f"camera.url = {self.name!r} is no network address; for files set camera.source to "
                '"file"'
            )
        self.remarks: list[str] = []
        self._n_dropped_before = 0
        """By connections that were closed."""
        self._config = config
        self._receiver: _Receiver | None = None

    @property
    def n_dropped(self) -> int:
        """Images that came damaged, or of which a newer one came first."""
        receiver = self._receiver
        return self._n_dropped_before + (0 if receiver is None else receiver.n_dropped)

    def open(self) -> None:
        """Connect; see `CameraSource`."""
        self.close()
        receiver = _Receiver(self._config, self.name)
        receiver.thread.start()
        if not receiver.opened.wait(OPEN_S + 1.0):
            receiver.end()
            raise SourceError(f"{self.name}: no answer in {OPEN_S + 1:g} s")
        if receiver.error is not None:
            raise receiver.error
        self._receiver = receiver

    def read(self, timeout_s: float) -> Picture | None:
        """Newest decoded image; see `CameraSource`."""
        receiver = self._receiver
        if receiver is None:
            raise SourceError(f"{self.name}: not open")
        newest = receiver.take(timeout_s)
        if newest is None:
            if receiver.error is not None:
                raise receiver.error
            return None
        return Picture(newest.monotonic_ns, *_arrays(newest.frame))

    def close(self) -> None:
        """Disconnect; a connection that hangs is left to its own timeout."""
        receiver, self._receiver = self._receiver, None
        if receiver is not None:
            receiver.end()
            self._n_dropped_before += receiver.n_dropped


class _Receiver:
    """Receives and decodes in a thread of its own: each image depends on the one before."""

    def __init__(self, config: CameraConfig, name: str) -> None:
        self.opened = threading.Event()
        self.error: Exception | None = None
        """SourceError or ConfigError, or else a bug, with its place."""
        self._config = config
        self._name = name
        self._ended = threading.Event()
        self._changed = threading.Condition()
        self._newest: _Newest | None = None
        self.n_dropped = 0
        self._heard_s = 0.0
        """Arrival of the last packet; RTSP reports a timeout as damaged data."""
        self.thread = threading.Thread(target=self._run, name="network camera", daemon=True)

    def take(self, timeout_s: float) -> _Newest | None:
        """Newest image, once only."""
        with self._changed:
            self._changed.wait_for(lambda: self._newest or self.error, timeout_s)
            newest, self._newest = self._newest, None
            return newest

    def end(self) -> None:
        self._ended.set()
        self.thread.join(0.3)

    def _run(self) -> None:
        error: Exception = EndOfPictures(f"{self._name}: closed")
        self._heard_s = time.monotonic()
        try:
            with av.open(
                self._config.url, options=_options(self._config), timeout=(OPEN_S, READ_S)
            ) as container:
                if not container.streams.video:
                    raise SourceError(f"{self._name}: there is no video in it")
                stream = container.streams.video[0]
                self._heard_s = time.monotonic()
                self.opened.set()
                self._decode(container, stream)
            error = SourceError(f"{self._name}: the sender has ended the stream")
        except SourceError as raised:
            error = raised
        except av.error.ProtocolNotFoundError:
            error = ConfigError(f"camera.url: {self._name}: not a protocol that FFmpeg knows")
        except av.error.FFmpegError as raised:
            # its own text holds the whole address, password and all
            limit_s = READ_S if self.opened.is_set() else OPEN_S
            silent = time.monotonic() - self._heard_s >= 0.9 * limit_s
            reason = "nothing came in time" if silent else _reason(raised)
            error = SourceError(f"{self._name}: {reason}")
        except OSError as raised:
            error = SourceError(f"{self._name}: {raised.strerror or type(raised).__name__}")
        except Exception as raised:  # handed to the camera's thread, which raises it
            error = raised
        finally:
            with self._changed:
                self.error = error
                self._changed.notify()
            self.opened.set()

    def _decode(self, container: av.container.InputContainer, stream: av.VideoStream) -> None:
        stream.thread_type = "SLICE"  # threads by frame would hold back a picture each
        stream.codec_context.flags |= av.codec.context.Flags.low_delay
        clock, last_ns = ArrivalClock(), 0
        stamped = not container.format.flags & NO_STAMPS
        for packet in container.demux(stream):
            arrived_ns = time.monotonic_ns()
            self._heard_s = arrived_ns * 1e-9
            if self._ended.is_set():
                return
            try:
                frames = packet.decode()
            except av.error.FFmpegError:
                self.n_dropped += 1
                continue
            for frame in frames:
                t_ns = arrived_ns
                if stamped and frame.pts is not None and frame.time_base is not None:
                    sent_ns = round(frame.pts * frame.time_base * 1_000_000_000)
                    t_ns = clock.monotonic_ns(sent_ns, arrived_ns)
                    if not clock.settled:
                        self.n_dropped += 1
                        continue
                if frame.is_corrupt or t_ns <= last_ns:
                    self.n_dropped += 1
                    continue
                last_ns = t_ns
                self._put(_Newest(frame, t_ns))

    def _put(self, newest: _Newest) -> None:
        with self._changed:
            self.n_dropped += self._newest is not None
            self._newest = newest
            self._changed.notify()


def without_secrets(url: str) -> str:
    """Address without user, password and query, fit to be printed."""
    try:
        parts = urlsplit(url)
        host = parts.hostname or ""
        port = f":{parts.port}" if parts.port else ""
    except ValueError:
        return url.split(":", 1)[0] + "://…"
    host = f"[{host}]" if ":" in host else host
    query = "?…" if parts.query else ""
    return f"{parts.scheme}://{host}{port}{parts.path}{query}"


def _options(config: CameraConfig) -> dict[str, str]:
    options = {"fflags": "nobuffer", "flags": "low_delay", "probesize": "500000",
               "analyzeduration": "500000", "fpsprobesize": "0"}  # fmt: skip
    if urlsplit(config.url).scheme in ("rtsp", "rtsps"):
        options["rtsp_transport"] = config.transport
        options["max_delay"] = str(MAX_WAIT_FOR_ORDER_US)
        options["reorder_queue_size"] = "64"
        options["allowed_media_types"] = "video"
    return options


def _arrays(frame: av.VideoFrame) -> tuple[Bytes, Bytes]:
    rgb = np.asarray(frame.to_ndarray(format="rgb24"), np.uint8)
    if frame.format.name not in BRIGHTNESS_FIRST:
        return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8), rgb
    plane = frame.planes[0]
    rows = np.frombuffer(memoryview(plane), np.uint8).reshape(-1, plane.line_size)
    return rows[: frame.height, : frame.width].copy(), rgb


def _reason(error: Any) -> str:
    if isinstance(error, av.error.HTTPUnauthorizedError | av.error.HTTPForbiddenError):
        return "user or password is wrong"
    return str(error.strerror or type(error).__name__).lower()
