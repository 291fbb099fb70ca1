"""Video4Linux cameras of this machine, and their capabilities."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from companion.errors import ConfigError, SourceError
from drivers.camera import v4l2_ioctl as v4l2
from drivers.camera.v4l2_node import CaptureNode, SizeRange

DEV = Path("/dev")
MAX_SIZES_NAMED = 24
NUMBERS = (
    v4l2.CTRL_TYPE_INTEGER, v4l2.CTRL_TYPE_BOOLEAN, v4l2.CTRL_TYPE_MENU,
    v4l2.CTRL_TYPE_INTEGER_MENU,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class CameraFormat:
    """Pixel format and size, and the frame rates available."""

    code: str
    width: int
    height: int
    rates_hz: tuple[float, ...] = ()
    """Fastest first; empty where the driver does not list them."""


@dataclass(frozen=True, slots=True)
class CameraControl:
    """A control that can be set."""

    name: str
    value: int | None
    minimum: int
    maximum: int
    step: int
    default: int
    choices: dict[int, str] = field(default_factory=dict)
    """Names of a menu's values."""


@dataclass(frozen=True, slots=True)
class CameraDevice:
    """A camera; `problem` is the reason why its capabilities could not be read."""

    path: str
    stable_path: str = ""
    name: str = ""
    driver: str = ""
    bus: str = ""
    formats: tuple[CameraFormat, ...] = ()
    controls: tuple[CameraControl, ...] = ()
    problem: str = ""


def cameras() -> list[CameraDevice]:
    """All capture devices; a camera's other nodes (metadata, output) are left out."""
    return [found for path in _nodes() if (found := _look_at(path)) is not None]


def find_camera() -> str:
    """Path of the only camera.

    SourceError where there is none, ConfigError where there are several.
    """
    found = [each for each in cameras() if each.formats]
    if not found:
        raise SourceError("no camera is there; plug one in, or set camera.device")
    if len(found) > 1:
        names = "; ".join(f"{each.stable_path or each.path} ({each.name})" for each in found)
        raise ConfigError(f"several cameras are there, set camera.device to one of: {names}")
    return found[0].stable_path or found[0].path


def stable_path(path: str) -> str:
    """Name under /dev/v4l/by-id, which survives replugging; "" without one."""
    target = os.path.realpath(path)
    for link in sorted((DEV / "v4l" / "by-id").glob("*")):
        if os.path.realpath(link) == target:
            return str(link)
    return ""


def sizes_of(node: CaptureNode, codes: Iterable[str]) -> str:
    """Sizes that a camera has in any of these formats, in words."""
    sizes = dict.fromkeys(_in_words(size) for code in codes for size in node.sizes(code))
    return ", ".join(list(sizes)[:MAX_SIZES_NAMED]) or "it does not say which"


def _in_words(size: SizeRange) -> str:
    least = f"{size.least[0]} x {size.least[1]}"
    return least if size.least == size.most else f"{least} to {size.most[0]} x {size.most[1]}"


def _nodes() -> list[str]:
    nodes = [each for each in DEV.glob("video*") if re.fullmatch(r"video\d+", each.name)]
    return [str(each) for each in sorted(nodes, key=lambda node: int(node.name[5:]))]


def _look_at(path: str) -> CameraDevice | None:
    try:
        fd = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        return CameraDevice(path, stable_path(path), problem=error.strerror or str(error))
    try:
        node = CaptureNode(fd)
        if not node.gives_pictures:
            return None
        return CameraDevice(
            path, stable_path(path), node.name, node.driver, node.bus,
            tuple(_formats(node)), tuple(_controls(node)),
        )  # fmt: skip
    except OSError as error:
        return CameraDevice(path, stable_path(path), problem=error.strerror or str(error))
    finally:
        os.close(fd)


def _formats(node: CaptureNode) -> Iterable[CameraFormat]:
    for code in node.codes():
        # of a range the ends say enough
        ends = [end for each in node.sizes(code) for end in (each.least, each.most)]
        sizes = list(dict.fromkeys(ends))
        if not sizes:
            now = node.format()
            sizes.append((now.width, now.height))
        for width, height in sizes:
            yield CameraFormat(code, width, height, tuple(node.rates_hz(code, width, height)))


def _controls(node: CaptureNode) -> Iterable[CameraControl]:
    for control in node.controls():
        if control.type not in NUMBERS or control.flags & v4l2.CTRL_FLAG_DISABLED:
            continue
        choices = node.menu(control) if control.type == v4l2.CTRL_TYPE_MENU else {}
        yield CameraControl(
            control.name.decode("utf-8", "replace").strip(), _value(node, control.id),
            control.minimum, control.maximum, control.step, control.default_value, choices,
        )  # fmt: skip


def _value(node: CaptureNode, number: int) -> int | None:
    try:
        return node.control(number)
    except OSError:  # write-only, or inactive while another is automatic
        return None
