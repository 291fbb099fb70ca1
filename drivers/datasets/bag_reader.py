"""Reader of ROS 1 and ROS 2 bags (sqlite or MCAP), with our errors."""

from __future__ import annotations

import struct
import sys
import zlib
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import apsw
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.interfaces import Connection
from rosbags.rosbag1 import ReaderError as Ros1Error
from rosbags.rosbag2 import ReaderError as Ros2Error
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_typestore

from companion.errors import FlightError

if sys.version_info >= (3, 14):
    from compression.zstd import ZstdError
else:
    from backports.zstd import ZstdError

DAMAGE = (
    AnyReaderError, Ros1Error, Ros2Error, SerdeError, TypesysError, ZstdError, apsw.Error,
    struct.error, zlib.error, ArithmeticError, AssertionError, AttributeError, EOFError,
    LookupError, MemoryError, OSError, RecursionError, RuntimeError, TypeError, ValueError,
)  # fmt: skip
"""Exceptions of the readers on damaged files."""
STAMP_AT = 4
"""Offset of a header's seconds and nanoseconds, in ROS 1 as in ROS 2."""


class BagMessage(NamedTuple):
    """Raw message of a bag; `recorded_ns` is the time of its recording."""

    topic: str
    kind: str
    recorded_ns: int
    raw: bytes


class Bag:
    """An open bag; `open_bag_file` makes one."""

    def __init__(self, reader: AnyReader, name: str) -> None:
        self._reader = reader
        self._name = name

    def topics(self) -> dict[str, tuple[str, int]]:
        """Type of each topic, as in `sensor_msgs/Image`, and its number of messages."""
        found: dict[str, tuple[str, int]] = {}
        for connection in self._reader.connections:
            _, n = found.get(connection.topic, ("", 0))
            found[connection.topic] = (_kind(connection), n + connection.msgcount)
        return found

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[BagMessage]:
        """Messages of these topics in order of their recording, start_ns <= recorded < stop_ns.

        FlightError where the bag is damaged, after what could be read.
        """
        wanted = [c for c in self._reader.connections if c.topic in topics]
        if not wanted:
            return
        try:
            for connection, t_ns, raw in self._reader.messages(wanted, start_ns, stop_ns):
                yield BagMessage(connection.topic, connection.msgtype, t_ns, bytes(raw))
        except DAMAGE as error:
            raise FlightError(f"{self._name}: damaged: {_line(error)}") from error

    def decoded(self, message: BagMessage) -> Any | None:
        """The message as an object with the fields of its definition; None if it is damaged."""
        try:
            return self._reader.deserialize(message.raw, message.kind)
        except DAMAGE:
            return None

    def stamp_ns(self, message: BagMessage) -> int:
        """Header stamp of a message; time of recording where that is empty."""
        if len(message.raw) < STAMP_AT + 8:
            return message.recorded_ns
        little = not self._reader.is2 or message.raw[1] & 1
        seconds, ns = struct.unpack_from("<II" if little else ">II", message.raw, STAMP_AT)
        return int(seconds * 1_000_000_000 + ns) or message.recorded_ns


@contextmanager
def open_bag_file(path: Path) -> Iterator[Bag]:
    """Bag in a file, or in a folder of one or several; FlightError where there is none."""
    several = sorted(path.glob("*.bag")) if path.is_dir() else []
    reader = None
    try:
        reader = AnyReader(several or [path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
    except DAMAGE as error:
        hint = "; `rosbag reindex` may repair it" if path.suffix == ".bag" else ""
        raise FlightError(f"{path}: not a bag that can be read: {_line(error)}{hint}") from error
    try:
        yield Bag(reader, path.name)
    finally:
        reader.close()


def _kind(connection: Connection) -> str:
    package, _, name = connection.msgtype.replace("/msg/", "/").rpartition("/")
    return f"{package}/{name}"


def _line(error: BaseException) -> str:
    text = str(error).strip() or type(error).__name__
    return text.splitlines()[0][:200]
