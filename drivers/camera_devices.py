"""The Video4Linux cameras of this machine, and what each can do."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from linuxpy.video import device as v4l2

from companion.errors import ConfigError, SourceError

DEV = Path("/dev")
CAPTURE = v4l2.BufferType.VIDEO_CAPTURE
MAX_SIZES_NAMED = 24


@dataclass(frozen=True, slots=True)
class CameraFormat:
    """Pictures of one code and size, and the rates at which they come."""

    code: str
    width: int
    height: int
    rates_hz: tuple[float, ...] = ()
    """Fastest first; nothing where the driver does not tell."""


@dataclass(frozen=True, slots=True)
class CameraControl:
    """A number that can be set."""

    name: str
    value: int | None
    minimum: int
    maximum: int
    step: int
    default: int
    choices: dict[int, str] = field(default_factory=dict)
    """What the values of a menu mean."""


@dataclass(frozen=True, slots=True)
class CameraDevice:
    """A camera; `problem` says why nothing more could be learnt of it."""

    path: str
    stable_path: str = ""
    name: str = ""
    driver: str = ""
    bus: str = ""
    formats: tuple[CameraFormat, ...] = ()
    controls: tuple[CameraControl, ...] = ()
    problem: str = ""


def cameras() -> list[CameraDevice]:
    """All that give pictures; a camera's other nodes (metadata, output) are left out."""
    return [found for path in _nodes() if (found := _look_at(path)) is not None]


def find_camera() -> str:
    """Path of the only camera there is.

    SourceError where there is none, ConfigError where several would do.
    """
    found = [each for each in cameras() if each.formats]
    if not found:
        raise SourceError("no camera is there; plug one in, or set camera.device")
    if len(found) > 1:
        names = "; ".join(f"{each.stable_path or each.path} ({each.name})" for each in found)
        raise ConfigError(f"several cameras are there, set camera.device to one of: {names}")
    return found[0].stable_path or found[0].path


def stable_path(path: str) -> str:
    """The name under /dev/v4l/by-id that a camera keeps when it is plugged in anew, or ""."""
    target = os.path.realpath(path)
    for link in sorted((DEV / "v4l" / "by-id").glob("*")):
        if os.path.realpath(link) == target:
            return str(link)
    return ""


def sizes_of(fd: int, codes: Iterable[str]) -> str:
    """The sizes that a camera has in any of these codes, in words."""
    sizes: dict[str, None] = {}
    for code in codes:
        for size in v4l2.iter_read_frame_sizes(fd, v4l2.raw.v4l2_fourcc(*code)):
            info = size.info
            if size.type == v4l2.FrameSizeType.DISCRETE:
                sizes[f"{info.width} x {info.height}"] = None
            else:
                sizes[
                    f"{info.min_width} x {info.min_height} to {info.max_width} x {info.max_height}"
                ] = None
    return ", ".join(list(sizes)[:MAX_SIZES_NAMED]) or "it does not say which"


def _nodes() -> list[str]:
    nodes = [each for each in DEV.glob("video*") if re.fullmatch(r"video\d+", each.name)]
    return [str(each) for each in sorted(nodes, key=lambda node: int(node.name[5:]))]


def _look_at(path: str) -> CameraDevice | None:
    try:
        fd = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        return CameraDevice(path, stable_path(path), problem=error.strerror or str(error))
    try:
        caps = v4l2.read_capabilities(fd)
        able = caps.device_caps or caps.capabilities
        wanted = v4l2.Capability.VIDEO_CAPTURE | v4l2.Capability.STREAMING
        if able & wanted != wanted:
            return None
        return CameraDevice(
            path, stable_path(path), _text(caps.card), _text(caps.driver), _text(caps.bus_info),
            tuple(_formats(fd)), tuple(_controls(fd)),
        )  # fmt: skip
    except (OSError, ValueError, ArithmeticError) as error:
        # linuxpy raises the last two over what a driver states wrongly
        return CameraDevice(path, stable_path(path), problem=str(error))
    finally:
        os.close(fd)


def _formats(fd: int) -> Iterable[CameraFormat]:
    for each in v4l2.iter_read_formats(fd, CAPTURE):
        number = int(each.pixel_format)
        code = v4l2.human_pixel_format(number)
        sizes = []
        for size in v4l2.iter_read_frame_sizes(fd, number):
            info = size.info
            if size.type == v4l2.FrameSizeType.DISCRETE:
                sizes.append((info.width, info.height))
            else:  # any between; the ends say enough
                sizes += [(info.min_width, info.min_height), (info.max_width, info.max_height)]
        if not sizes:
            pix = v4l2.get_raw_format(fd, CAPTURE).fmt.pix
            sizes.append((pix.width, pix.height))
        for width, height in sizes:
            rates = {
                round(float(rate.max_fps), 3)
                for rate in v4l2.iter_read_frame_intervals(fd, number, width, height)
            }
            yield CameraFormat(code, width, height, tuple(sorted(rates - {0.0}, reverse=True)))


def _controls(fd: int) -> Iterable[CameraControl]:
    numbers = {
        v4l2.ControlType.INTEGER, v4l2.ControlType.BOOLEAN, v4l2.ControlType.MENU,
        v4l2.ControlType.INTEGER_MENU,
    }  # fmt: skip
    for control in v4l2.iter_read_controls(fd):
        if control.type not in numbers or control.flags & v4l2.ControlFlag.DISABLED:
            continue
        yield CameraControl(
            _text(control.name), _value(fd, control), control.minimum, control.maximum,
            control.step, control.default_value, _choices(fd, control),
        )  # fmt: skip


def _value(fd: int, control: Any) -> int | None:
    try:
        return int(v4l2.get_control(fd, control.id))
    except OSError:  # write-only, or inactive while another is automatic
        return None


def _choices(fd: int, control: Any) -> dict[int, str]:
    if control.type != v4l2.ControlType.MENU:
        return {}
    out = {}
    for index in range(control.minimum, control.maximum + 1):
        entry = v4l2.raw.v4l2_querymenu()
        entry.id, entry.index = control.id, index
        try:
            v4l2.ioctl(fd, v4l2.IOC.QUERYMENU, entry)
        except OSError:  # menus have holes
            continue
        out[index] = _text(entry.name)
    return out


def _text(raw: bytes) -> str:
    return raw.split(b"\0")[0].decode("utf-8", "replace").strip()
