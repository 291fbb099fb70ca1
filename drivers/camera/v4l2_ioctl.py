"""Video4Linux capture interface of the kernel: structures, constants and requests.

Names are those of linux/videodev2.h, without their prefix; layouts are those of 64-bit Linux,
which are the same on x86-64 and aarch64.
"""

from __future__ import annotations

import ctypes
import fcntl
from ctypes import c_char, c_int32, c_int64, c_uint8, c_uint16, c_uint32, c_uint64
from typing import Any

CAP_VIDEO_CAPTURE = 0x1
CAP_VIDEO_CAPTURE_MPLANE = 0x1000
CAP_STREAMING = 0x0400_0000
CAP_DEVICE_CAPS = 0x8000_0000
"""`device_caps` is valid: capabilities of this node, not of the whole device."""

BUF_TYPE_VIDEO_CAPTURE = 1
BUF_TYPE_VIDEO_CAPTURE_MPLANE = 9
MEMORY_MMAP = 1

FRMSIZE_TYPE_DISCRETE = 1
FRMIVAL_TYPE_DISCRETE = 1

BUF_FLAG_ERROR = 0x40
BUF_FLAG_TIMESTAMP_MASK = 0xE000
BUF_FLAG_TIMESTAMP_MONOTONIC = 0x2000
BUF_FLAG_TSTAMP_SRC_MASK = 0x7_0000
BUF_FLAG_TSTAMP_SRC_EOF = 0x0
"""Stamp at the end of the frame."""
BUF_FLAG_TSTAMP_SRC_SOE = 0x1_0000
"""Stamp at the start of the exposure."""

CTRL_TYPE_INTEGER = 1
CTRL_TYPE_BOOLEAN = 2
CTRL_TYPE_MENU = 3
CTRL_TYPE_INTEGER_MENU = 9
CTRL_FLAG_DISABLED = 0x1
CTRL_FLAG_READ_ONLY = 0x4
CTRL_FLAG_NEXT_CTRL = 0x8000_0000
"""With the number of a control: enumerate the next one."""

CID_AUTOGAIN = 0x98_0912
CID_GAIN = 0x98_0913
CID_EXPOSURE_AUTO = 0x9A_0901
CID_EXPOSURE_ABSOLUTE = 0x9A_0902
CID_EXPOSURE_AUTO_PRIORITY = 0x9A_0903
CID_FOCUS_ABSOLUTE = 0x9A_090A
CID_FOCUS_AUTO = 0x9A_090C
CID_ANALOGUE_GAIN = 0x9E_0903
EXPOSURE_MANUAL = 1
"""Value of CID_EXPOSURE_AUTO."""

MAX_PLANES = 8


def _words(names: str) -> tuple[tuple[str, Any], ...]:
    """Fields of 32 bits without sign, one after the other."""
    return tuple((name, c_uint32) for name in names.split())


class Capability(ctypes.Structure):
    """struct v4l2_capability."""

    _fields_ = (
        ("driver", c_char * 16), ("card", c_char * 32), ("bus_info", c_char * 32),
        *_words("version capabilities device_caps"), ("reserved", c_uint32 * 3),
    )  # fmt: skip


class Fmtdesc(ctypes.Structure):
    """struct v4l2_fmtdesc."""

    _fields_ = (
        *_words("index type flags"), ("description", c_char * 32), ("pixelformat", c_uint32),
        ("mbus_code", c_uint32), ("reserved", c_uint32 * 3),
    )  # fmt: skip


class Frmsizeenum(ctypes.Structure):
    """struct v4l2_frmsizeenum: `size` is width and height, or least, most and step of each."""

    _fields_ = (
        *_words("index pixel_format type"), ("size", c_uint32 * 6), ("reserved", c_uint32 * 2),
    )  # fmt: skip


class Fract(ctypes.Structure):
    """struct v4l2_fract."""

    _fields_ = (("numerator", c_uint32), ("denominator", c_uint32))


class Frmivalenum(ctypes.Structure):
    """struct v4l2_frmivalenum: `interval` is the only one, or the shortest, longest and step."""

    _fields_ = (
        *_words("index pixel_format width height type"), ("interval", Fract * 3),
        ("reserved", c_uint32 * 2),
    )  # fmt: skip


class PixFormat(ctypes.Structure):
    """struct v4l2_pix_format."""

    _fields_ = (
        *_words("width height pixelformat field bytesperline sizeimage colorspace priv"),
        *_words("flags ycbcr_enc quantization xfer_func"),
    )  # fmt: skip


class PlanePixFormat(ctypes.Structure):
    """struct v4l2_plane_pix_format."""

    _fields_ = (("sizeimage", c_uint32), ("bytesperline", c_uint32), ("reserved", c_uint16 * 6))


class PixFormatMplane(ctypes.Structure):
    """struct v4l2_pix_format_mplane."""

    _fields_ = (
        *_words("width height pixelformat field colorspace"),
        ("plane_fmt", PlanePixFormat * MAX_PLANES), ("num_planes", c_uint8), ("flags", c_uint8),
        ("ycbcr_enc", c_uint8), ("quantization", c_uint8), ("xfer_func", c_uint8),
        ("reserved", c_uint8 * 7),
    )  # fmt: skip


class _FormatUnion(ctypes.Union):
    # other kinds of device have pointers in here: the union is aligned as one
    _fields_ = (("pix", PixFormat), ("pix_mp", PixFormatMplane), ("raw_data", c_uint64 * 25))


class Format(ctypes.Structure):
    """struct v4l2_format."""

    _fields_ = (("type", c_uint32), ("fmt", _FormatUnion))


class Captureparm(ctypes.Structure):
    """struct v4l2_captureparm."""

    _fields_ = (
        ("capability", c_uint32), ("capturemode", c_uint32), ("timeperframe", Fract),
        ("extendedmode", c_uint32), ("readbuffers", c_uint32), ("reserved", c_uint32 * 4),
    )  # fmt: skip


class _ParmUnion(ctypes.Union):
    _fields_ = (("capture", Captureparm), ("raw_data", c_uint8 * 200))


class Streamparm(ctypes.Structure):
    """struct v4l2_streamparm."""

    _fields_ = (("type", c_uint32), ("parm", _ParmUnion))


class Requestbuffers(ctypes.Structure):
    """struct v4l2_requestbuffers."""

    _fields_ = (
        *_words("count type memory capabilities"), ("flags", c_uint8), ("reserved", c_uint8 * 3),
    )  # fmt: skip


class Timeval(ctypes.Structure):
    """struct timeval of a 64-bit system."""

    _fields_ = (("tv_sec", c_int64), ("tv_usec", c_int64))


class Timecode(ctypes.Structure):
    """struct v4l2_timecode."""

    _fields_ = (
        ("type", c_uint32), ("flags", c_uint32), ("frames", c_uint8), ("seconds", c_uint8),
        ("minutes", c_uint8), ("hours", c_uint8), ("userbits", c_uint8 * 4),
    )  # fmt: skip


class _PlanePlace(ctypes.Union):
    _fields_ = (("mem_offset", c_uint32), ("userptr", c_uint64), ("fd", c_int32))


class Plane(ctypes.Structure):
    """struct v4l2_plane."""

    _fields_ = (
        ("bytesused", c_uint32), ("length", c_uint32), ("m", _PlanePlace),
        ("data_offset", c_uint32), ("reserved", c_uint32 * 11),
    )  # fmt: skip


class _BufferPlace(ctypes.Union):
    _fields_ = (
        ("offset", c_uint32), ("userptr", c_uint64), ("planes", ctypes.POINTER(Plane)),
        ("fd", c_int32),
    )  # fmt: skip


class Buffer(ctypes.Structure):
    """struct v4l2_buffer."""

    _fields_ = (
        *_words("index type bytesused flags field"), ("timestamp", Timeval), ("timecode", Timecode),
        ("sequence", c_uint32), ("memory", c_uint32), ("m", _BufferPlace), ("length", c_uint32),
        ("reserved2", c_uint32), ("request_fd", c_int32),
    )  # fmt: skip


class Queryctrl(ctypes.Structure):
    """struct v4l2_queryctrl."""

    _fields_ = (
        ("id", c_uint32), ("type", c_uint32), ("name", c_char * 32), ("minimum", c_int32),
        ("maximum", c_int32), ("step", c_int32), ("default_value", c_int32), ("flags", c_uint32),
        ("reserved", c_uint32 * 2),
    )  # fmt: skip


class Querymenu(ctypes.Structure):
    """struct v4l2_querymenu, of a menu of names."""

    _fields_ = (
        ("id", c_uint32), ("index", c_uint32), ("name", c_char * 32), ("reserved", c_uint32),
    )  # fmt: skip


class Control(ctypes.Structure):
    """struct v4l2_control."""

    _fields_ = (("id", c_uint32), ("value", c_int32))


_WRITTEN = 1
_READ = 2


def _request(direction: int, number: int, about: Any) -> int:
    """Number of an ioctl: direction, size of the argument, "V", number."""
    return direction << 30 | ctypes.sizeof(about) << 16 | ord("V") << 8 | number


QUERYCAP = _request(_READ, 0, Capability)
ENUM_FMT = _request(_READ | _WRITTEN, 2, Fmtdesc)
G_FMT = _request(_READ | _WRITTEN, 4, Format)
S_FMT = _request(_READ | _WRITTEN, 5, Format)
REQBUFS = _request(_READ | _WRITTEN, 8, Requestbuffers)
QUERYBUF = _request(_READ | _WRITTEN, 9, Buffer)
QBUF = _request(_READ | _WRITTEN, 15, Buffer)
DQBUF = _request(_READ | _WRITTEN, 17, Buffer)
STREAMON = _request(_WRITTEN, 18, c_int32)
STREAMOFF = _request(_WRITTEN, 19, c_int32)
G_PARM = _request(_READ | _WRITTEN, 21, Streamparm)
S_PARM = _request(_READ | _WRITTEN, 22, Streamparm)
G_CTRL = _request(_READ | _WRITTEN, 27, Control)
S_CTRL = _request(_READ | _WRITTEN, 28, Control)
QUERYCTRL = _request(_READ | _WRITTEN, 36, Queryctrl)
QUERYMENU = _request(_READ | _WRITTEN, 37, Querymenu)
ENUM_FRAMESIZES = _request(_READ | _WRITTEN, 74, Frmsizeenum)
ENUM_FRAMEINTERVALS = _request(_READ | _WRITTEN, 75, Frmivalenum)


def ask(fd: int, request: int, about: Any) -> None:
    """Pass `about` to the driver, which answers in it; OSError where it refuses.

    A request interrupted by a signal is repeated after the signal's handler.
    """
    while True:
        try:
            fcntl.ioctl(fd, request, about)
        except InterruptedError:
            continue
        return
