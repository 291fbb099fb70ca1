"""Structures against linux/videodev2.h: values of a C compiler on a 64-bit system."""

from __future__ import annotations

import ctypes
from types import SimpleNamespace
from typing import Any

import pytest

from drivers.camera import v4l2_ioctl as v4l2

# The size of what is handed over is in bits 16 to 29.
REQUESTS = {
    "QUERYCAP": 0x8068_5600, "ENUM_FMT": 0xC040_5602, "G_FMT": 0xC0D0_5604, "S_FMT": 0xC0D0_5605,
    "REQBUFS": 0xC014_5608, "QUERYBUF": 0xC058_5609, "QBUF": 0xC058_560F, "DQBUF": 0xC058_5611,
    "STREAMON": 0x4004_5612, "STREAMOFF": 0x4004_5613, "G_PARM": 0xC0CC_5615,
    "S_PARM": 0xC0CC_5616, "G_CTRL": 0xC008_561B, "S_CTRL": 0xC008_561C, "QUERYCTRL": 0xC044_5624,
    "QUERYMENU": 0xC02C_5625, "ENUM_FRAMESIZES": 0xC02C_564A, "ENUM_FRAMEINTERVALS": 0xC034_564B,
}  # fmt: skip
PARTS = {"PixFormat": 48, "PixFormatMplane": 192, "PlanePixFormat": 20, "Captureparm": 40,
         "Plane": 64, "Timecode": 16, "Timeval": 16}  # fmt: skip
OFFSETS = {
    ("Capability", "capabilities"): 84, ("Fmtdesc", "pixelformat"): 44,
    ("Frmsizeenum", "size"): 12, ("Frmivalenum", "interval"): 20, ("Format", "fmt"): 8,
    ("PixFormatMplane", "plane_fmt"): 20, ("PixFormatMplane", "num_planes"): 180,
    ("Streamparm", "parm"): 4, ("Captureparm", "timeperframe"): 8, ("Buffer", "timestamp"): 24,
    ("Buffer", "sequence"): 56, ("Buffer", "m"): 64, ("Buffer", "length"): 72, ("Plane", "m"): 8,
    ("Plane", "data_offset"): 16, ("Queryctrl", "minimum"): 40, ("Queryctrl", "flags"): 56,
}  # fmt: skip


def test_requests_are_those_of_the_kernel() -> None:
    assert {name: getattr(v4l2, name) for name in REQUESTS} == REQUESTS


def test_structures_lie_in_memory_as_the_kernel_has_them() -> None:
    assert {name: ctypes.sizeof(getattr(v4l2, name)) for name in PARTS} == PARTS
    found = {place: getattr(getattr(v4l2, place[0]), place[1]).offset for place in OFFSETS}
    assert found == OFFSETS


def test_a_request_that_a_signal_interrupted_is_made_again(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[int] = []

    def ioctl(_: int, request: int, about: Any) -> int:
        made.append(request)
        if len(made) == 1:
            raise InterruptedError
        about.value = 7
        return 0

    monkeypatch.setattr(v4l2, "fcntl", SimpleNamespace(ioctl=ioctl))
    about = v4l2.Control(id=v4l2.CID_GAIN)
    v4l2.ask(0, v4l2.G_CTRL, about)
    assert made == [v4l2.G_CTRL] * 2
    assert about.value == 7
