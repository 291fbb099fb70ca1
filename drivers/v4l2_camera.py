"""USB and other cameras of Video4Linux, by linuxpy: stamped by the driver, not when they are read.

linuxpy serves as codec of the ioctls; its own streaming classes hide the flags of a buffer, which
tell what its stamp means.
"""

from __future__ import annotations

import errno
import mmap
import os
import select
import time
from dataclasses import dataclass
from typing import Any

from linuxpy.video import device as v4l2

from companion.config import CameraConfig
from companion.errors import ConfigError, SourceError
from drivers.camera_devices import find_camera, sizes_of, stable_path
from drivers.camera_source import Picture
from drivers.pixel_formats import CODES, to_grey_and_rgb
from drivers.v4l2_controls import apply_controls

CAPTURE = v4l2.BufferType.VIDEO_CAPTURE
N_BUFFERS = 4
MAX_AGE_NS = 2_000_000_000
"""A stamp further than this from now is not of the clock that the driver says."""
MAX_RATE_SHORTFALL = 0.9
GONE = (errno.ENODEV, errno.ENOENT, errno.ENXIO, errno.EIO, errno.EPIPE, errno.EPROTO)


@dataclass(slots=True)
class _Stream:
    fd: int
    code: str
    width: int
    height: int
    stride: int
    buffers: list[mmap.mmap]
    exposure_ns: int
    sequence: int | None = None
    """Number that the driver gave to the last picture."""
    stamped_by_us: bool = False


class V4l2Camera:
    """A camera at /dev/video…; the one that was opened first is the one opened again."""

    live = True
    start_s = 4.0
    silent_s = 1.0

    def __init__(self, config: CameraConfig) -> None:
        self._config = config
        self.name = config.device if config.device != "auto" else "the only camera"
        self.n_dropped = 0
        self.remarks: list[str] = []
        self._path: str | None = None if config.device == "auto" else config.device
        self._stream: _Stream | None = None

    def open(self) -> None:
        """Set format, rate and controls, and begin; see `CameraSource`."""
        self.close()
        path = self._path or find_camera()
        try:
            fd = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            raise SourceError(_cannot_open(path, error)) from error
        try:
            self._stream = self._begin(path, fd)
        except OSError as error:
            raise SourceError(
                f"{path}: the camera cannot be started: {error.strerror or error}"
            ) from error
        finally:
            if self._stream is None:
                os.close(fd)
        stable = stable_path(path)
        self.name = stable or path
        if stable or self._path:  # else the search begins anew: a number is given to the next comer
            self._path = stable or self._path

    def read(self, timeout_s: float) -> Picture | None:
        """The newest picture in the driver's queue; see `CameraSource`."""
        stream = self._stream
        if stream is None:
            raise SourceError(f"{self.name}: the camera is not open")
        deadline_s = time.monotonic() + timeout_s
        while True:
            left_s = deadline_s - time.monotonic()
            try:
                buffer = self._newest(stream, max(0.0, left_s))
                if buffer is not None:
                    picture = self._picture(stream, buffer)
                    _enqueue(stream.fd, buffer.index)
                    if picture is not None:
                        return picture
                    self.n_dropped += 1
            except OSError as error:
                raise SourceError(f"{self.name}: the camera has gone: {error.strerror}") from error
            if left_s <= 0:
                return None

    def close(self) -> None:
        """Stop and give the device back, so that it can come back under its own name."""
        stream, self._stream = self._stream, None
        if stream is None:
            return
        for buffer in stream.buffers:
            buffer.close()
        try:
            v4l2.stream_off(stream.fd, CAPTURE)
        except OSError:
            pass  # unplugged: it has stopped by itself
        os.close(stream.fd)

    def _begin(self, path: str, fd: int) -> _Stream:
        config = self._config
        code, width, height, stride = self._set_format(path, fd)
        self._set_rate(path, fd)
        exposure_ns, remarks = apply_controls(path, fd, config)
        self.remarks += remarks
        made = v4l2.request_buffers(fd, CAPTURE, v4l2.Memory.MMAP, N_BUFFERS)
        buffers: list[mmap.mmap] = []
        for index in range(made.count):
            buffer = v4l2.query_buffer(fd, CAPTURE, v4l2.Memory.MMAP, index)
            buffers.append(mmap.mmap(fd, buffer.length, offset=buffer.m.offset))
            _enqueue(fd, index)
        v4l2.stream_on(fd, CAPTURE)
        return _Stream(fd, code, width, height, stride, buffers, exposure_ns)

    def _set_format(self, path: str, fd: int) -> tuple[str, int, int, int]:
        config = self._config
        offered = [v4l2.human_pixel_format(f) for f in _pixel_formats(fd)]
        wanted = config.pixel_format.upper()
        if wanted == "AUTO":
            codes = _by_preference(fd, offered, config)
        elif wanted in offered and wanted in CODES:
            codes = [wanted]
        else:
            raise ConfigError(
                f"{path}: camera.pixel_format = {config.pixel_format!r} is none of those that it "
                f"has ({', '.join(offered)}) and we read ({', '.join(CODES)})"
            )
        if not codes:
            raise ConfigError(
                f"{path}: it offers {', '.join(offered) or 'no pictures'}; read are "
                + ", ".join(CODES)
            )
        for code in codes:
            pix = v4l2.set_format(fd, CAPTURE, config.width, config.height, code).fmt.pix
            given = v4l2.human_pixel_format(pix.pixelformat)
            if (pix.width, pix.height, given) == (config.width, config.height, code):
                return code, pix.width, pix.height, 0 if code == "MJPG" else pix.bytesperline
        raise ConfigError(
            f"{path}: no pictures of {config.width} x {config.height} as {' or '.join(codes)}; "
            f"set camera.width and camera.height to one of: {sizes_of(fd, codes)}"
        )

    def _set_rate(self, path: str, fd: int) -> None:
        wanted = self._config.rate_hz
        try:
            v4l2.set_fps(fd, CAPTURE, wanted)
            given = float(v4l2.get_fps(fd, CAPTURE))
        except (OSError, ZeroDivisionError):
            self.remarks.append(f"{path}: its rate cannot be set, {wanted:g}/s was asked")
            return
        if abs(given - wanted) > (1 - MAX_RATE_SHORTFALL) * wanted:
            self.remarks.append(f"{path}: it gives {given:g} pictures/s, {wanted:g} were asked")

    def _newest(self, stream: _Stream, timeout_s: float) -> Any | None:
        poll = select.poll()
        poll.register(stream.fd, select.POLLIN)
        ready = poll.poll(timeout_s * 1e3)
        if not ready:
            return None
        newest = None
        while True:
            try:
                buffer = v4l2.dequeue_buffer(stream.fd, CAPTURE, v4l2.Memory.MMAP)
            except BlockingIOError:
                if newest is None and ready[0][1] & (select.POLLERR | select.POLLHUP):
                    raise OSError(errno.ENODEV, "no longer there") from None
                return newest
            if newest is not None:
                _enqueue(stream.fd, newest.index)
                self.n_dropped += 1
            newest = buffer
            if stream.sequence is not None:  # gaps are what the driver itself had to drop
                self.n_dropped += max(0, buffer.sequence - stream.sequence - 1)
            stream.sequence = buffer.sequence

    def _picture(self, stream: _Stream, buffer: Any) -> Picture | None:
        now_ns = time.monotonic_ns()
        if buffer.flags & v4l2.BufferFlag.ERROR or not buffer.bytesused:
            return None
        view = memoryview(stream.buffers[buffer.index])
        try:
            arrays = to_grey_and_rgb(
                stream.code, view[: buffer.bytesused], stream.width, stream.height, stream.stride
            )
        finally:
            view.release()
        if arrays is None:
            return None
        return Picture(self._mid_exposure_ns(stream, buffer, now_ns), *arrays)

    def _mid_exposure_ns(self, stream: _Stream, buffer: Any, now_ns: int) -> int:
        kind = buffer.flags & v4l2.BufferFlag.TIMESTAMP_MASK
        stamp_ns = buffer.timestamp.secs * 1_000_000_000 + buffer.timestamp.usecs * 1_000
        stated = kind == v4l2.BufferFlag.TIMESTAMP_MONOTONIC
        if not stated or abs(now_ns - stamp_ns) > MAX_AGE_NS:
            if not stream.stamped_by_us:
                stream.stamped_by_us = True
                why = "far from now" if stated else "not of a known clock"
                self.remarks.append(
                    f"{self.name}: the driver's stamps are {why}; pictures are stamped when read"
                )
            stamp_ns = now_ns
            source = v4l2.BufferFlag.TSTAMP_SRC_EOF
        else:
            source = buffer.flags & v4l2.BufferFlag.TSTAMP_SRC_MASK
        half_ns = stream.exposure_ns // 2
        starts = source == v4l2.BufferFlag.TSTAMP_SRC_SOE
        return int(stamp_ns + half_ns if starts else stamp_ns - half_ns)


def _enqueue(fd: int, index: int) -> None:
    v4l2.enqueue_buffer(fd, CAPTURE, v4l2.Memory.MMAP, 0, index)


def _pixel_formats(fd: int) -> list[int]:
    return [int(each.pixel_format) for each in v4l2.iter_read_formats(fd, CAPTURE)]


def _by_preference(fd: int, offered: list[str], config: CameraConfig) -> list[str]:
    """Codes that can be read, those first that are fast enough at this size, then as in CODES."""
    known = [code for code in CODES if code in offered]

    def too_slow(code: str) -> bool:
        number = v4l2.raw.v4l2_fourcc(*code)
        rates = [
            float(each.max_fps)
            for each in v4l2.iter_read_frame_intervals(fd, number, config.width, config.height)
        ]
        return max(rates, default=0.0) < MAX_RATE_SHORTFALL * config.rate_hz

    return sorted(known, key=too_slow)


def _cannot_open(path: str, error: OSError) -> str:
    if error.errno == errno.EACCES:
        return f"{path}: may not be opened: add the user to the group video"
    if error.errno == errno.EBUSY:
        return f"{path}: another program uses the camera"
    if error.errno in GONE:
        return f"{path}: there is no such camera now"
    return f"{path}: cannot be opened: {error.strerror}"
