"""A USB camera as its driver shows it, at the level of ioctls: the tables are those of a webcam.

Its node is an ordinary file in a folder of the test, whose bytes are the memory of the buffers.
"""

from __future__ import annotations

import errno
import fcntl
import os
import time
from collections import deque
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from linuxpy.video import device as v4l2
from linuxpy.video import raw

import drivers.camera_devices

PAGES = 1 << 20
Sizes = dict[tuple[int, int], tuple[int, ...]]
SIZES: dict[str, Sizes] = {"YUYV": {(640, 480): (30, 15), (1280, 720): (10,)},
                           "MJPG": {(640, 480): (30,), (1280, 720): (30,)}}  # fmt: skip
ID = v4l2.ControlID
MONOTONIC_SOE = int(v4l2.BufferFlag.TIMESTAMP_MONOTONIC | v4l2.BufferFlag.TSTAMP_SRC_SOE)
MONOTONIC_EOF = int(v4l2.BufferFlag.TIMESTAMP_MONOTONIC)


class FakeV4l2:
    """One camera; plug it in under a number, pull it out, have it stop or stutter."""

    def __init__(self, folder: Path, serial: str = "0A1B") -> None:
        self.folder = folder
        self.name = f"usb-Acme_Webcam_{serial}-video-index0"
        self.sizes = {code: dict(sizes) for code, sizes in SIZES.items()}
        self.flags = MONOTONIC_SOE
        self.lag_ns = 7_000_000
        """What the stamp is older than the end of the transfer."""
        self.rate_hz = 100.0
        self.silent = False
        self.damaged = False
        self.pulled = True
        self.n_lost = 0
        self.last_stamp_ns = 0
        # id: name, type, least, most, step, default
        self.controls: dict[int, list[Any]] = {
            int(ID.GAIN): [b"Gain", 1, 0, 255, 1, 64],
            int(ID.EXPOSURE_AUTO): [b"Auto Exposure", 3, 0, 3, 1, 3],
            int(ID.EXPOSURE_ABSOLUTE): [b"Exposure Time, Absolute", 1, 3, 2047, 1, 250],
            int(ID.EXPOSURE_AUTO_PRIORITY): [b"Exposure, Dynamic Framerate", 2, 0, 1, 1, 1],
            int(ID.FOCUS_ABSOLUTE): [b"Focus, Absolute", 1, 0, 250, 5, 0],
            int(ID.FOCUS_AUTO): [b"Focus, Automatic Continuous", 2, 0, 1, 1, 1],
        }
        self.values = {number: each[5] for number, each in self.controls.items()}
        self.format: tuple[str, int, int] = ("MJPG", 1280, 720)
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
        os.truncate(self._node, 8 * PAGES)
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
        if self.pulled:
            raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))
        getattr(self, "_" + v4l2.IOC(request).name.lower())(fd, about)
        return 0

    def _querycap(self, _: int, about: Any) -> None:
        about.driver, about.card, about.bus_info = b"uvcvideo", b"Acme Webcam", b"usb-0000:00-2"
        about.device_caps = v4l2.Capability.VIDEO_CAPTURE | v4l2.Capability.STREAMING

    def _enum_fmt(self, _: int, about: Any) -> None:
        about.pixelformat = raw.v4l2_fourcc(*_nth(list(self.sizes), about.index))
        about.description = b"as it says"

    def _enum_framesizes(self, _: int, about: Any) -> None:
        sizes = self.sizes.get(v4l2.human_pixel_format(about.pixel_format), {})
        about.type = 1
        about.m1.discrete.width, about.m1.discrete.height = _nth(list(sizes), about.index)

    def _enum_frameintervals(self, _: int, about: Any) -> None:
        sizes = self.sizes.get(v4l2.human_pixel_format(about.pixel_format), {})
        about.type = 1
        rate = _nth(list(sizes.get((about.width, about.height), ())), about.index)
        about.discrete.numerator, about.discrete.denominator = 1, rate

    def _s_fmt(self, _: int, about: Any) -> None:
        pix = about.fmt.pix
        code = v4l2.human_pixel_format(pix.pixelformat)
        code = code if code in self.sizes else "MJPG"
        size = pix.width, pix.height
        self.format = (code, *(size if size in self.sizes[code] else (640, 480)))
        self._g_fmt(0, about)

    def _g_fmt(self, _: int, about: Any) -> None:
        code, width, height = self.format
        pix = about.fmt.pix
        pix.width, pix.height, pix.pixelformat = width, height, raw.v4l2_fourcc(*code)
        pix.bytesperline = 2 * width if code == "YUYV" else 0
        pix.sizeimage = 2 * width * height

    def _s_parm(self, _: int, about: Any) -> None:
        asked = about.parm.capture.timeperframe
        code, width, height = self.format
        able = self.sizes[code][width, height]
        self.fps = min(able, key=lambda rate: abs(rate - asked.denominator / asked.numerator))
        self._g_parm(0, about)

    def _g_parm(self, _: int, about: Any) -> None:
        per_frame = about.parm.capture.timeperframe
        per_frame.numerator, per_frame.denominator = 1, self.fps

    def _query_ext_ctrl(self, _: int, about: Any) -> None:
        last = about.id & 0x0FFFFFFF
        number = next((n for n in sorted(self.controls) if n > last), None)
        if number is None:
            raise OSError(errno.EINVAL, "no more")
        about.id = number
        (about.name, about.type, about.minimum, about.maximum, about.step,
         about.default_value) = self.controls[number]  # fmt: skip
        about.flags = 0

    def _querymenu(self, _: int, about: Any) -> None:
        names = {1: b"Manual Mode", 3: b"Aperture Priority Mode"}
        if about.index not in names:
            raise OSError(errno.EINVAL, "a hole")
        about.name = names[about.index]

    def _g_ctrl(self, _: int, about: Any) -> None:
        about.value = self.values[about.id]

    def _s_ctrl(self, _: int, about: Any) -> None:
        step = self.controls[about.id][4]
        self.values[about.id] = about.value // step * step

    def _reqbufs(self, _: int, about: Any) -> None:
        about.count = min(about.count, 4)

    def _querybuf(self, _: int, about: Any) -> None:
        about.length, about.m.offset = PAGES, about.index * PAGES

    def _qbuf(self, _: int, about: Any) -> None:
        assert about.index not in self._queued, "a buffer was queued twice"
        self._queued.append(about.index)

    def _streamon(self, _: int, __: Any) -> None:
        self._streaming, self._next_s, self._sequence = True, time.monotonic(), 0

    def _streamoff(self, _: int, __: Any) -> None:
        self._streaming = False

    def _dqbuf(self, fd: int, about: Any) -> None:
        if not self._streaming or self.silent or time.monotonic() < self._next_s:
            time.sleep(0.0005)  # where a device would not be readable, a file is
            raise BlockingIOError(errno.EAGAIN, "not yet")
        if not self._queued:
            raise BlockingIOError(errno.EAGAIN, "no buffer")
        self._next_s += 1 / self.rate_hz
        data = self._data()
        about.index = self._queued.popleft()
        os.pwrite(fd, data, about.index * PAGES)
        about.bytesused = len(data)
        about.flags = self.flags | (v4l2.BufferFlag.ERROR if self.damaged else 0)
        self.last_stamp_ns = time.monotonic_ns() - self.lag_ns
        about.timestamp.secs = self.last_stamp_ns // 1_000_000_000
        about.timestamp.usecs = self.last_stamp_ns % 1_000_000_000 // 1000
        about.sequence = self._sequence + self.n_lost
        self._sequence += 1

    def _data(self) -> bytes:
        code, width, height = self.format
        picture = np.full((height, width, 2), 128, np.uint8)
        picture[..., 0] = 40 + (np.arange(width) + 8 * self._sequence) % 160
        if code == "YUYV":
            return picture.tobytes()
        made = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_YUV2BGR_YUYV))[1]
        return bytes(made.tobytes())


def _nth(values: list[Any], index: int) -> Any:
    if index >= len(values):
        raise OSError(errno.EINVAL, "no more")
    return values[index]


def install(monkeypatch: pytest.MonkeyPatch, *fakes: FakeV4l2) -> None:
    """Let ioctls reach these cameras, and look for cameras in their folder only."""

    def ioctl(fd: int, request: int, *about: Any) -> int:
        for fake in fakes:
            if fake.is_at(fd):
                return fake.ioctl(fd, request, *about)
        return int(fcntl.ioctl(fd, request, *about))

    monkeypatch.setattr("linuxpy.ioctl.fcntl", SimpleNamespace(ioctl=ioctl))
    monkeypatch.setattr(drivers.camera_devices, "DEV", fakes[0].folder)
