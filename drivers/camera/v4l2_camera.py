"""Video4Linux cameras (USB and others), stamped by the driver."""

from __future__ import annotations

import errno
import mmap
import os
import select
import time
from dataclasses import dataclass

from companion.config import CameraConfig
from companion.errors import ConfigError, SourceError
from drivers.camera import v4l2_ioctl as v4l2
from drivers.camera.camera_devices import find_camera, sizes_of, stable_path
from drivers.camera.camera_source import Picture
from drivers.camera.exposure_choice import Exposure, ExposureRange
from drivers.camera.live_exposure import left_to_itself
from drivers.camera.pixel_formats import CODES, to_grey_and_rgb
from drivers.camera.v4l2_controls import ManualExposure, apply_controls
from drivers.camera.v4l2_node import CaptureNode, FilledBuffer, PictureFormat

N_BUFFERS = 4
MAX_AGE_NS = 2_000_000_000
"""A stamp further from now is not of the clock that the driver states."""
MAX_RATE_SHORTFALL = 0.9
GONE = (errno.ENODEV, errno.ENOENT, errno.ENXIO, errno.EIO, errno.EPIPE, errno.EPROTO)


@dataclass(slots=True)
class _Stream:
    fd: int
    node: CaptureNode
    format: PictureFormat
    buffers: list[mmap.mmap]
    exposure_ns: int
    manual: ManualExposure | None = None
    """Exposure chosen in flight."""
    sequence: int | None = None
    """Sequence number of the last image."""
    stamped_by_us: bool = False


class V4l2Camera:
    """Camera at /dev/video…; reopens the one that was opened first."""

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
        """Set format, rate and controls, and start; see `CameraSource`."""
        self.close()
        path = self._path or find_camera()
        try:
            fd = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            raise SourceError(f"{path}: {_cannot_open(error)}") from error
        try:
            self._stream = self._begin(path, fd)
        except OSError as error:
            raise SourceError(f"{path}: {_cannot_start(error)}") from error
        finally:
            if self._stream is None:
                os.close(fd)
        stable = stable_path(path)
        self.name = stable or path
        if stable or self._path:  # else the search begins anew: a number is given to the next comer
            self._path = stable or self._path

    def read(self, timeout_s: float) -> Picture | None:
        """Newest image in the driver's queue; see `CameraSource`."""
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
                    stream.node.enqueue(buffer.index)
                    if picture is not None:
                        return picture
                    self.n_dropped += 1
            except OSError as error:
                raise SourceError(f"{self.name}: the camera has gone: {error.strerror}") from error
            if left_s <= 0:
                return None

    @property
    def exposure_range(self) -> tuple[ExposureRange, Exposure] | None:
        """Limits of what can be set, and the setting; None where the camera chooses for itself."""
        manual = self._stream.manual if self._stream is not None else None
        return None if manual is None else (manual.range, manual.now)

    def set_exposure(self, wanted: Exposure) -> Exposure | None:
        """Set exposure and gain; what the camera took.

        None where it refuses: it is left to its own automatic exposure from then on.
        """
        stream = self._stream
        if stream is None or stream.manual is None:
            return None
        try:
            taken = stream.manual.put(wanted)
        except OSError as error:
            stream.manual.give_back()
            stream.manual, stream.exposure_ns = None, 0
            if error.errno != errno.ENODEV:  # else it has gone, as the next read will say
                self.remarks.append(left_to_itself(self.name, f"refused: {error.strerror}"))
            return None
        stream.exposure_ns = taken.exposure_us * 1_000
        return taken

    def close(self) -> None:
        """Stop and release the device, so that it can come back under its own name."""
        stream, self._stream = self._stream, None
        if stream is None:
            return
        if stream.manual is not None:
            stream.manual.give_back()
        for buffer in stream.buffers:
            buffer.close()
        try:
            stream.node.stop()
        except OSError:
            pass  # unplugged: it has stopped by itself
        os.close(stream.fd)

    def _begin(self, path: str, fd: int) -> _Stream:
        node = CaptureNode(fd)
        if not node.gives_pictures:
            raise ConfigError(f"{path}: this node of {node.name} gives no pictures; name another")
        form = self._set_format(path, node)
        self._set_rate(path, node)
        exposure_ns, remarks = apply_controls(path, node, self._config)
        self.remarks += remarks
        buffers = node.make_buffers(N_BUFFERS)
        try:
            for index in range(len(buffers)):
                node.enqueue(index)
            node.start()
        except OSError:
            for buffer in buffers:  # a mapping keeps the device busy
                buffer.close()
            raise
        stream = _Stream(fd, node, form, buffers, exposure_ns)
        if self._config.exposure == "tracking":
            self._take_over_exposure(path, stream)
        return stream

    def _take_over_exposure(self, path: str, stream: _Stream) -> None:
        try:
            stream.manual = ManualExposure(stream.node)
            stream.exposure_ns = stream.manual.now.exposure_us * 1_000
        except SourceError as error:
            self.remarks.append(left_to_itself(path, str(error)))

    def _set_format(self, path: str, node: CaptureNode) -> PictureFormat:
        config = self._config
        offered = node.codes()
        wanted = config.pixel_format.upper()
        if wanted == "AUTO":
            codes = _by_preference(node, offered, config)
        elif wanted in offered and wanted in CODES:
            codes = [wanted]
        else:
            raise ConfigError(
                f"{path}: expert.camera.pixel_format = {config.pixel_format!r} is none of those it "
                f"has ({', '.join(offered)}) and we read ({', '.join(CODES)})"
            )
        if not codes:
            raise ConfigError(
                f"{path}: it offers {', '.join(offered) or 'no pictures'}; read are "
                + ", ".join(CODES)
            )
        for code in codes:
            given = node.set_format(code, config.width, config.height)
            same = (given.code, given.width, given.height) == (code, config.width, config.height)
            if same and given.n_planes == 1:
                return given
        raise ConfigError(
            f"{path}: no pictures of {config.width} x {config.height} as {' or '.join(codes)}; "
            f"set camera.width and camera.height to one of: {sizes_of(node, codes)}"
        )

    def _set_rate(self, path: str, node: CaptureNode) -> None:
        wanted = self._config.rate_hz
        try:
            given = node.set_rate(wanted)
        except OSError:
            given = 0.0
        if not given:
            self.remarks.append(f"{path}: its rate cannot be set, {wanted:g}/s was asked")
        elif abs(given - wanted) > (1 - MAX_RATE_SHORTFALL) * wanted:
            self.remarks.append(f"{path}: it gives {given:g} pictures/s, {wanted:g} were asked")

    def _newest(self, stream: _Stream, timeout_s: float) -> FilledBuffer | None:
        poll = select.poll()
        poll.register(stream.fd, select.POLLIN)
        ready = poll.poll(timeout_s * 1e3)
        if not ready:
            return None
        newest = None
        for _ in stream.buffers:  # no more: where pictures come faster than they go there is no end
            buffer = stream.node.dequeue()
            if buffer is None:
                if newest is None and ready[0][1] & (select.POLLERR | select.POLLHUP):
                    raise OSError(errno.ENODEV, "no longer there")
                break
            if newest is not None:
                stream.node.enqueue(newest.index)
                self.n_dropped += 1
            newest = buffer
            if stream.sequence is not None:  # gaps are what the driver itself had to drop
                self.n_dropped += max(0, buffer.sequence - stream.sequence - 1)
            stream.sequence = buffer.sequence
        return newest

    def _picture(self, stream: _Stream, buffer: FilledBuffer) -> Picture | None:
        now_ns = time.monotonic_ns()
        if buffer.flags & v4l2.BUF_FLAG_ERROR or buffer.end <= buffer.start:
            return None
        form = stream.format
        view = memoryview(stream.buffers[buffer.index])
        try:
            arrays = to_grey_and_rgb(
                form.code, view[buffer.start : buffer.end], form.width, form.height, form.stride
            )
        finally:
            view.release()
        if arrays is None:
            return None
        return Picture(self._mid_exposure_ns(stream, buffer, now_ns), *arrays)

    def _mid_exposure_ns(self, stream: _Stream, buffer: FilledBuffer, now_ns: int) -> int:
        kind = buffer.flags & v4l2.BUF_FLAG_TIMESTAMP_MASK
        stamp_ns = buffer.stamp_ns
        stated = kind == v4l2.BUF_FLAG_TIMESTAMP_MONOTONIC
        if not stated or abs(now_ns - stamp_ns) > MAX_AGE_NS:
            if not stream.stamped_by_us:
                stream.stamped_by_us = True
                why = "far from now" if stated else "not of a known clock"
                self.remarks.append(
                    f"{self.name}: the driver's stamps are {why}; pictures are stamped when read"
                )
            stamp_ns = now_ns
            source = v4l2.BUF_FLAG_TSTAMP_SRC_EOF
        else:
            source = buffer.flags & v4l2.BUF_FLAG_TSTAMP_SRC_MASK
        half_ns = stream.exposure_ns // 2
        starts = source == v4l2.BUF_FLAG_TSTAMP_SRC_SOE
        return stamp_ns + half_ns if starts else stamp_ns - half_ns


def _by_preference(node: CaptureNode, offered: list[str], config: CameraConfig) -> list[str]:
    """Supported formats, those first that are fast enough at this size, then as in CODES."""
    known = [code for code in CODES if code in offered]

    def too_slow(code: str) -> bool:
        rates = node.rates_hz(code, config.width, config.height)
        return max(rates, default=0.0) < MAX_RATE_SHORTFALL * config.rate_hz

    return sorted(known, key=too_slow)


def _cannot_open(error: OSError) -> str:
    if error.errno == errno.EACCES:
        return "may not be opened: add the user to the group video"
    if error.errno == errno.EBUSY:
        return "another program uses the camera"
    if error.errno in GONE:
        return "there is no such camera now"
    return f"cannot be opened: {error.strerror}"


def _cannot_start(error: OSError) -> str:
    if error.errno == errno.EBUSY:
        return "another program uses the camera"
    if error.errno == errno.ENOTTY:
        return "it is no camera"
    return f"the camera cannot be started: {error.strerror or error}"
