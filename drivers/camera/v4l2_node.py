"""Video4Linux device node: capabilities, settings, buffers."""

from __future__ import annotations

import ctypes
import errno
import mmap
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from drivers.camera import v4l2_ioctl as v4l2

MAX_ENTRIES = 1024
"""Limit of a driver's list, which may never end."""
END_OF_LIST = (errno.EINVAL, errno.ENOTTY, errno.ENODATA)
"""Errors at the end of a list: past the last entry, no such list, none for this input."""
MAX_DENOMINATOR = 1001
"""Denominator that represents rates such as 30000/1001 exactly."""


@dataclass(frozen=True, slots=True)
class SizeRange:
    """Range of sizes of a camera: for a single size both ends are equal."""

    least: tuple[int, int]
    """Width and height."""
    most: tuple[int, int]


@dataclass(frozen=True, slots=True)
class PictureFormat:
    """Memory layout of images; `stride` is bytes per row, 0 where they have no rows."""

    code: str
    width: int
    height: int
    stride: int
    n_planes: int


@dataclass(frozen=True, slots=True)
class FilledBuffer:
    """Buffer filled by the driver: the image is in bytes `start` to `end`."""

    index: int
    start: int
    end: int
    stamp_ns: int
    flags: int
    """BUF_FLAG_…: damage, clock of the stamp, and its moment."""
    sequence: int


class CaptureNode:
    """An open /dev/video…; every call is OSError where the driver refuses or has gone.

    Images must lie in one plane, on multi-planar devices too.
    """

    def __init__(self, fd: int) -> None:
        self._fd = fd
        about = v4l2.Capability()
        v4l2.ask(fd, v4l2.QUERYCAP, about)
        self.name, self.driver, self.bus = map(_text, (about.card, about.driver, about.bus_info))
        whole_device = not about.capabilities & v4l2.CAP_DEVICE_CAPS
        able = about.capabilities if whole_device else about.device_caps
        self._mplane = not able & v4l2.CAP_VIDEO_CAPTURE
        self._type = (
            v4l2.BUF_TYPE_VIDEO_CAPTURE_MPLANE if self._mplane else v4l2.BUF_TYPE_VIDEO_CAPTURE
        )
        captures = able & (v4l2.CAP_VIDEO_CAPTURE | v4l2.CAP_VIDEO_CAPTURE_MPLANE)
        self.gives_pictures = bool(captures and able & v4l2.CAP_STREAMING)

    def codes(self) -> list[str]:
        """FourCC codes of the formats, in the driver's order."""
        listed = self._each(v4l2.ENUM_FMT, lambda: v4l2.Fmtdesc(type=self._type))
        return [_code(each.pixelformat) for each in listed]

    def sizes(self, code: str) -> list[SizeRange]:
        """Sizes of this format; empty where the driver does not list them."""
        out = []
        for each in self._each(
            v4l2.ENUM_FRAMESIZES, lambda: v4l2.Frmsizeenum(pixel_format=_number(code))
        ):
            if each.type == v4l2.FRMSIZE_TYPE_DISCRETE:
                one = each.size[0], each.size[1]
                out.append(SizeRange(one, one))
            else:
                out.append(SizeRange((each.size[0], each.size[3]), (each.size[1], each.size[4])))
        return out

    def rates_hz(self, code: str, width: int, height: int) -> list[float]:
        """Rates of this format and size, of a range both ends, fastest first."""
        rates = set()
        for each in self._each(
            v4l2.ENUM_FRAMEINTERVALS,
            lambda: v4l2.Frmivalenum(pixel_format=_number(code), width=width, height=height),
        ):
            n_stated = 1 if each.type == v4l2.FRMIVAL_TYPE_DISCRETE else 2
            rates |= {_rate_hz(each.interval[n]) for n in range(n_stated)}
        return sorted(rates - {0.0}, reverse=True)

    def format(self) -> PictureFormat:
        """Format in force."""
        about = v4l2.Format(type=self._type)
        v4l2.ask(self._fd, v4l2.G_FMT, about)
        return self._stated(about)

    def set_format(self, code: str, width: int, height: int) -> PictureFormat:
        """Set a format; the one that the driver took, which may differ."""
        about = v4l2.Format(type=self._type)
        pix = about.fmt.pix_mp if self._mplane else about.fmt.pix
        pix.width, pix.height, pix.pixelformat = width, height, _number(code)
        v4l2.ask(self._fd, v4l2.S_FMT, about)
        return self._stated(about)

    def set_rate(self, rate_hz: float) -> float:
        """Set a rate; the one that the driver took, 0 where unknown."""
        asked = Fraction(rate_hz).limit_denominator(MAX_DENOMINATOR)
        about = v4l2.Streamparm(type=self._type)
        interval = about.parm.capture.timeperframe
        interval.numerator, interval.denominator = asked.denominator, asked.numerator
        v4l2.ask(self._fd, v4l2.S_PARM, about)
        about = v4l2.Streamparm(type=self._type)
        v4l2.ask(self._fd, v4l2.G_PARM, about)
        return _rate_hz(about.parm.capture.timeperframe)

    def controls(self) -> list[Any]:
        """`v4l2_ioctl.Queryctrl` of each control, by rising number."""
        out: list[Any] = []
        while len(out) < MAX_ENTRIES:
            last = out[-1].id if out else 0
            about = v4l2.Queryctrl(id=last | v4l2.CTRL_FLAG_NEXT_CTRL)
            if not self._listed(v4l2.QUERYCTRL, about) or about.id <= last:
                break
            out.append(about)
        return out

    def menu(self, control: Any) -> dict[int, str]:
        """Names of the values of a menu control."""
        out = {}
        for index in range(max(0, control.minimum), min(control.maximum + 1, MAX_ENTRIES)):
            about = v4l2.Querymenu(id=control.id, index=index)
            if self._listed(v4l2.QUERYMENU, about):  # menus have holes
                out[index] = _text(about.name)
        return out

    def control(self, number: int) -> int:
        """Value of a control."""
        about = v4l2.Control(id=number)
        v4l2.ask(self._fd, v4l2.G_CTRL, about)
        return int(about.value)

    def set_control(self, number: int, value: int) -> None:
        """Set a control; the driver may take a value near by."""
        v4l2.ask(self._fd, v4l2.S_CTRL, v4l2.Control(id=number, value=value))

    def make_buffers(self, n: int) -> list[mmap.mmap]:
        """Allocate the driver's memory for `n` images, or as many as it has, not yet queued."""
        made = v4l2.Requestbuffers(count=n, type=self._type, memory=v4l2.MEMORY_MMAP)
        v4l2.ask(self._fd, v4l2.REQBUFS, made)
        buffers: list[mmap.mmap] = []
        try:
            for index in range(made.count):
                about, plane = self._buffer(index)
                v4l2.ask(self._fd, v4l2.QUERYBUF, about)
                length = plane.length if self._mplane else about.length
                offset = plane.m.mem_offset if self._mplane else about.m.offset
                buffers.append(mmap.mmap(self._fd, length, offset=offset))
        except BaseException:
            for buffer in buffers:  # a mapping keeps the device busy
                buffer.close()
            raise
        return buffers

    def enqueue(self, index: int) -> None:
        """Give a buffer to the driver."""
        about, _ = self._buffer(index)
        v4l2.ask(self._fd, v4l2.QBUF, about)

    def dequeue(self) -> FilledBuffer | None:
        """Oldest filled buffer, None without one; it is ours until queued again."""
        about, plane = self._buffer(0)
        try:
            v4l2.ask(self._fd, v4l2.DQBUF, about)
        except BlockingIOError:
            return None
        return FilledBuffer(
            int(about.index),
            int(plane.data_offset) if self._mplane else 0,
            int(plane.bytesused if self._mplane else about.bytesused),
            about.timestamp.tv_sec * 1_000_000_000 + about.timestamp.tv_usec * 1_000,
            int(about.flags),
            int(about.sequence),
        )

    def start(self) -> None:
        """Start streaming."""
        v4l2.ask(self._fd, v4l2.STREAMON, ctypes.c_int32(self._type))

    def stop(self) -> None:
        """Stop streaming; all buffers are ours again."""
        v4l2.ask(self._fd, v4l2.STREAMOFF, ctypes.c_int32(self._type))

    def _buffer(self, index: int) -> tuple[Any, Any]:
        about = v4l2.Buffer(index=index, type=self._type, memory=v4l2.MEMORY_MMAP)
        planes = (v4l2.Plane * v4l2.MAX_PLANES)()
        if self._mplane:
            about.m.planes = planes  # which `about` keeps alive
            about.length = len(planes)
        return about, planes[0]

    def _stated(self, about: Any) -> PictureFormat:
        if self._mplane:
            pix = about.fmt.pix_mp
            stride, n_planes = pix.plane_fmt[0].bytesperline, int(pix.num_planes)
        else:
            pix = about.fmt.pix
            stride, n_planes = pix.bytesperline, 1
        return PictureFormat(_code(pix.pixelformat), pix.width, pix.height, stride, n_planes)

    def _each(self, request: int, make: Callable[[], Any]) -> Iterator[Any]:
        for index in range(MAX_ENTRIES):
            about = make()
            about.index = index
            if not self._listed(request, about):
                return
            yield about

    def _listed(self, request: int, about: Any) -> bool:
        try:
            v4l2.ask(self._fd, request, about)
        except OSError as error:
            if error.errno in END_OF_LIST:
                return False
            raise
        return True


def _code(number: int) -> str:
    return number.to_bytes(4, "little").decode("latin-1")


def _number(code: str) -> int:
    return int.from_bytes(code.encode("latin-1"), "little")


def _rate_hz(interval: Any) -> float:
    if not interval.numerator:
        return 0.0
    return round(float(interval.denominator / interval.numerator), 3)


def _text(raw: bytes) -> str:
    return raw.decode("utf-8", "replace").strip()
