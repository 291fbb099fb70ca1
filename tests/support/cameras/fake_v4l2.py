"""Simulated Video4Linux driver, by the structures of the kernel: its tables are a webcam's.

Its node is an ordinary file in a folder of the test, whose bytes are the memory of the buffers.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

import drivers.camera.camera_devices
from drivers.camera import v4l2_ioctl as v4l2

PAGES = 1 << 20
N_BUFFERS = 4
Sizes = dict[tuple[int, int], tuple[int, ...]]
SIZES: dict[str, Sizes] = {"YUYV": {(640, 480): (30, 15), (1280, 720): (10,)},
                           "MJPG": {(640, 480): (30,), (1280, 720): (30,)}}  # fmt: skip
MPLANE_SIZES: dict[str, Sizes] = {"NV12": {(640, 480): (30,)}}
NV12_GAP = 32
"""Bytes behind each row."""
DATA_OFFSET = 256
"""Bytes before a multi-planar picture, which count as used."""
MONOTONIC_SOE = v4l2.BUF_FLAG_TIMESTAMP_MONOTONIC | v4l2.BUF_FLAG_TSTAMP_SRC_SOE
MONOTONIC_EOF = v4l2.BUF_FLAG_TIMESTAMP_MONOTONIC | v4l2.BUF_FLAG_TSTAMP_SRC_EOF
REQUESTS = {
    getattr(v4l2, name): name
    for name in (
        "QUERYCAP", "ENUM_FMT", "ENUM_FRAMESIZES", "ENUM_FRAMEINTERVALS", "G_FMT", "S_FMT",
        "G_PARM", "S_PARM", "QUERYCTRL", "QUERYMENU", "G_CTRL", "S_CTRL", "REQBUFS", "QUERYBUF",
        "QBUF", "DQBUF", "STREAMON", "STREAMOFF",
    )
}  # fmt: skip


class FakeV4l2:
    """One camera; plug it in under a number, pull it out, have it stop or stutter."""

    def __init__(self, folder: Path, serial: str = "0A1B", *, mplane: bool = False) -> None:
        self.folder = folder
        self.mplane = mplane
        self.name = f"usb-Acme_Webcam_{serial}-video-index0"
        self.sizes = {
            code: dict(sizes) for code, sizes in (MPLANE_SIZES if mplane else SIZES).items()
        }
        self.flags = MONOTONIC_SOE
        self.lag_ns = 7_000_000
        """What the stamp is older than the end of the transfer."""
        self.rate_hz = 100.0
        self.silent = False
        self.damaged = False
        self.pulled = True
        self.n_lost = 0
        self.last_stamp_ns = 0
        self.refused: dict[int, int] = {}
        """Requests that fail, and with which errno."""
        # id: name, type, least, most, step, default
        self.controls: dict[int, list[Any]] = {
            v4l2.CID_GAIN: [b"Gain", v4l2.CTRL_TYPE_INTEGER, 0, 255, 1, 64],
            v4l2.CID_EXPOSURE_AUTO: [b"Auto Exposure", v4l2.CTRL_TYPE_MENU, 0, 3, 1, 3],
            v4l2.CID_EXPOSURE_ABSOLUTE:
                [b"Exposure Time, Absolute", v4l2.CTRL_TYPE_INTEGER, 3, 2047, 1, 250],
            v4l2.CID_EXPOSURE_AUTO_PRIORITY:
                [b"Exposure, Dynamic Framerate", v4l2.CTRL_TYPE_BOOLEAN, 0, 1, 1, 1],
            v4l2.CID_FOCUS_ABSOLUTE: [b"Focus, Absolute", v4l2.CTRL_TYPE_INTEGER, 0, 250, 5, 0],
            v4l2.CID_FOCUS_AUTO:
                [b"Focus, Automatic Continuous", v4l2.CTRL_TYPE_BOOLEAN, 0, 1, 1, 1],
        }  # fmt: skip
        self.values = {number: each[5] for number, each in self.controls.items()}
        self.fixed: set[int] = set()
        """Controls that refuse to be set."""
        self.control_after_last: Callable[[int], int] | None = None
        """Of a driver whose list does not end: the number that it names after this one."""
        self.n_requests = 0
        code = list(self.sizes)[-1]
        self.format: tuple[str, int, int] = (code, *list(self.sizes[code])[-1])
        self.fps = 30
        self._queued: deque[int] = deque()
        self._sequence = 0
        self._streaming = False
        self._next_s = 0.0
        self._node: Path | None = None

    @property
    def stable_path(self) -> str:
        return str(self.folder / "v4l" / "by-id" / self.name)

    def plug_in(self, number: int) -> None:
        links = self.folder / "v4l" / "by-id"
        links.mkdir(parents=True, exist_ok=True)
        self._node = self.folder / f"video{number}"
        self._node.write_bytes(b"")
        os.truncate(self._node, 2 * N_BUFFERS * PAGES)
        (links / self.name).symlink_to(self._node)
        self.pulled, self._streaming = False, False
        self._queued.clear()

    def pull_out(self) -> None:
        assert self._node is not None
        self.pulled = True
        Path(self.stable_path).unlink()
        self._node.unlink()

    def is_at(self, fd: int) -> bool:
        path = os.readlink(f"/proc/self/fd/{fd}").removesuffix(" (deleted)")
        return self._node is not None and path == str(self._node)

    def ioctl(self, fd: int, request: int, about: Any) -> int:
        self.n_requests += 1
        assert ctypes.sizeof(about) == request >> 16 & 0x3FFF
        if self.pulled:
            raise _refusal(errno.ENODEV)
        if request in self.refused:
            raise _refusal(self.refused[request])
        own = v4l2.BUF_TYPE_VIDEO_CAPTURE_MPLANE if self.mplane else v4l2.BUF_TYPE_VIDEO_CAPTURE
        if request in (v4l2.STREAMON, v4l2.STREAMOFF):
            kind = about.value
        elif isinstance(about, v4l2.Queryctrl | v4l2.Frmsizeenum | v4l2.Frmivalenum):
            kind = own  # these have a type too, which is another matter
        else:
            kind = getattr(about, "type", own)
        if kind != own or getattr(about, "memory", v4l2.MEMORY_MMAP) != v4l2.MEMORY_MMAP:
            raise _refusal(errno.EINVAL)
        getattr(self, "_" + REQUESTS[request].lower())(fd, about)
        return 0

    def _querycap(self, _: int, about: Any) -> None:
        about.driver, about.card, about.bus_info = b"uvcvideo", b"Acme Webcam", b"usb-0000:00-2"
        captures = v4l2.CAP_VIDEO_CAPTURE_MPLANE if self.mplane else v4l2.CAP_VIDEO_CAPTURE
        about.device_caps = captures | v4l2.CAP_STREAMING
        output = 0x2  # which another node of the same device has
        about.capabilities = about.device_caps | v4l2.CAP_DEVICE_CAPS | output

    def _enum_fmt(self, _: int, about: Any) -> None:
        about.pixelformat = _number(_nth(list(self.sizes), about.index))
        about.description = b"as it says"

    def _enum_framesizes(self, _: int, about: Any) -> None:
        sizes = self.sizes.get(_code(about.pixel_format), {})
        about.type = v4l2.FRMSIZE_TYPE_DISCRETE
        about.size[0], about.size[1] = _nth(list(sizes), about.index)

    def _enum_frameintervals(self, _: int, about: Any) -> None:
        sizes = self.sizes.get(_code(about.pixel_format), {})
        about.type = v4l2.FRMIVAL_TYPE_DISCRETE
        rate = _nth(list(sizes.get((about.width, about.height), ())), about.index)
        about.interval[0].numerator, about.interval[0].denominator = 1, rate

    def _s_fmt(self, _: int, about: Any) -> None:
        pix = about.fmt.pix_mp if self.mplane else about.fmt.pix
        code = _code(pix.pixelformat)
        code = code if code in self.sizes else list(self.sizes)[-1]
        size = pix.width, pix.height
        self.format = (code, *(size if size in self.sizes[code] else (640, 480)))
        self._g_fmt(0, about)

    def _g_fmt(self, _: int, about: Any) -> None:
        code, width, height = self.format
        pix = about.fmt.pix_mp if self.mplane else about.fmt.pix
        pix.width, pix.height, pix.pixelformat = width, height, _number(code)
        if self.mplane:
            pix.num_planes = 1
        layout = pix.plane_fmt[0] if self.mplane else pix
        layout.bytesperline = {"YUYV": 2 * width, "NV12": width + NV12_GAP}.get(code, 0)
        layout.sizeimage = 2 * width * height

    def _s_parm(self, _: int, about: Any) -> None:
        asked = about.parm.capture.timeperframe
        code, width, height = self.format
        able = self.sizes[code][width, height]
        self.fps = min(able, key=lambda rate: abs(rate - asked.denominator / asked.numerator))
        self._g_parm(0, about)

    def _g_parm(self, _: int, about: Any) -> None:
        per_frame = about.parm.capture.timeperframe
        per_frame.numerator, per_frame.denominator = 1, self.fps

    def _queryctrl(self, _: int, about: Any) -> None:
        assert about.id & v4l2.CTRL_FLAG_NEXT_CTRL
        last = about.id & ~v4l2.CTRL_FLAG_NEXT_CTRL
        number = next((n for n in sorted(self.controls) if n > last), None)
        if number is None:
            if self.control_after_last is None:
                raise _refusal(errno.EINVAL)
            about.id, about.type = self.control_after_last(last), v4l2.CTRL_TYPE_INTEGER
            return
        about.id = number
        (about.name, about.type, about.minimum, about.maximum, about.step,
         about.default_value) = self.controls[number]  # fmt: skip

    def _querymenu(self, _: int, about: Any) -> None:
        names = {1: b"Manual Mode", 3: b"Aperture Priority Mode"}
        if about.index not in names:  # a hole
            raise _refusal(errno.EINVAL)
        about.name = names[about.index]

    def _g_ctrl(self, _: int, about: Any) -> None:
        if about.id not in self.values:
            raise _refusal(errno.EINVAL)
        about.value = self.values[about.id]

    def _s_ctrl(self, _: int, about: Any) -> None:
        if about.id in self.fixed:
            raise _refusal(errno.EACCES)
        step = self.controls[about.id][4]
        self.values[about.id] = about.value // step * step

    def _reqbufs(self, _: int, about: Any) -> None:
        about.count = min(about.count, N_BUFFERS)
        self._queued.clear()

    def _querybuf(self, _: int, about: Any) -> None:
        plane = self._plane(about)
        if plane is None:
            about.length, about.m.offset = PAGES, about.index * PAGES
        else:
            about.length = 1
            plane.length, plane.m.mem_offset = PAGES, about.index * PAGES

    def _qbuf(self, _: int, about: Any) -> None:
        self._plane(about)
        assert about.index < N_BUFFERS
        assert about.index not in self._queued, "a buffer was queued twice"
        self._queued.append(about.index)

    def _streamon(self, _: int, __: Any) -> None:
        self._streaming, self._next_s, self._sequence = True, time.monotonic(), 0

    def _streamoff(self, _: int, __: Any) -> None:
        self._streaming = False
        self._queued.clear()

    def _dqbuf(self, fd: int, about: Any) -> None:
        plane = self._plane(about)
        if not self._streaming or self.silent or time.monotonic() < self._next_s:
            time.sleep(0.0005)  # where a device would not be readable, a file is
            raise _refusal(errno.EAGAIN)
        if not self._queued:
            raise _refusal(errno.EAGAIN)
        # by its own clock: who comes late finds pictures that wait, a period apart
        filled_s = max(self._next_s, time.monotonic() - N_BUFFERS / self.rate_hz)
        self._next_s = filled_s + 1 / self.rate_hz
        data = self._data()
        about.index = self._queued.popleft()
        if plane is None:
            about.bytesused = len(data)
        else:
            data = b"\xff" * DATA_OFFSET + data
            plane.data_offset, plane.bytesused = DATA_OFFSET, len(data)
        os.pwrite(fd, data, about.index * PAGES)
        about.flags = self.flags | (v4l2.BUF_FLAG_ERROR if self.damaged else 0)
        self.last_stamp_ns = int(filled_s * 1e9) - self.lag_ns
        about.timestamp.tv_sec = self.last_stamp_ns // 1_000_000_000
        about.timestamp.tv_usec = self.last_stamp_ns % 1_000_000_000 // 1000
        about.sequence = self._sequence + self.n_lost
        self._sequence += 1

    def _plane(self, about: Any) -> Any | None:
        """What the caller has room for, None where the device is not multi-planar."""
        if not self.mplane:
            return None
        if not (about.m.planes and 1 <= about.length <= v4l2.MAX_PLANES):
            raise _refusal(errno.EINVAL)
        return about.m.planes[0]

    def _data(self) -> bytes:
        code, width, height = self.format
        row = (40 + (np.arange(width) + 8 * self._sequence) % 160).astype(np.uint8)
        if code == "NV12":
            rows = np.full((height * 3 // 2, width + NV12_GAP), 128, np.uint8)
            rows[:height, :width] = row
            return rows.tobytes()
        picture = np.full((height, width, 2), 128, np.uint8)
        picture[..., 0] = row
        if code == "YUYV":
            return picture.tobytes()
        made = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_YUV2BGR_YUYV))[1]
        return bytes(made.tobytes())


def _code(number: int) -> str:
    return number.to_bytes(4, "little").decode()


def _number(code: str) -> int:
    return int.from_bytes(code.encode(), "little")


def _nth(values: list[Any], index: int) -> Any:
    if index >= len(values):
        raise _refusal(errno.EINVAL)
    return values[index]


def _refusal(number: int) -> OSError:
    return OSError(number, os.strerror(number))


def install(monkeypatch: pytest.MonkeyPatch, *fakes: FakeV4l2) -> None:
    """Let ioctls reach these cameras, and look for cameras in their folder only."""

    def ioctl(fd: int, request: int, about: Any) -> int:
        for fake in fakes:
            if fake.is_at(fd):
                return fake.ioctl(fd, request, about)
        return int(fcntl.ioctl(fd, request, about))

    monkeypatch.setattr("drivers.camera.v4l2_ioctl.fcntl", SimpleNamespace(ioctl=ioctl))
    monkeypatch.setattr(drivers.camera.camera_devices, "DEV", fakes[0].folder)
