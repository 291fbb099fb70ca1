"""Small logs and videos written byte by byte or by the formats' own libraries."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega as mavlink

START_NS = 1_762_000_000_000_000_000


class Tlog:
    """A telemetry log in the making; packets lie in it in order of their arrival."""

    def __init__(self, data: bytes = b"") -> None:
        self._packets: list[tuple[int, bytes]] = [(0, data)]

    @property
    def data(self) -> bytes:
        """The whole file."""
        return b"".join(packet for _, packet in sorted(self._packets, key=lambda each: each[0]))

    def add(self, unix_ns: int, message: Any, system: int = 1, component: int = 1) -> None:
        codec = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
        packet = struct.pack(">Q", unix_ns // 1000) + bytes(message.pack(codec))
        self._packets.append((unix_ns, packet))


def attitude(boot_ns: int, roll: float, pitch: float, yaw: float) -> Any:
    return mavlink.MAVLink_attitude_message(boot_ns // 10**6, roll, pitch, yaw, 0.1, 0.2, 0.3)


def heartbeat(armed: bool, autopilot: int = mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA) -> Any:
    mode = mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0
    return mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_QUADROTOR, autopilot, mode, 0, 4, 3)


def picture(number: int, width: int = 64, height: int = 48) -> NDArray[np.uint8]:
    """A picture that says by its brightness which one it is."""
    image = np.full((height, width, 3), 20 + 12 * number, np.uint8)
    image[: height // 2, : width // 2] = [200, 10, 10]  # red above left, so that nothing is turned
    return image


def write_video(path: Path, n_frames: int = 10, **options: str) -> None:
    with av.open(str(path), "w", options={"movflags": "faststart"}) as writer:
        stream = writer.add_stream("libx264", rate=10, options={"crf": "5", "g": "4", **options})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for number in range(n_frames):
            frame = av.VideoFrame.from_ndarray(picture(number), format="rgb24")
            frame.pts, frame.time_base = number, Fraction(1, 10)
            writer.mux(stream.encode(frame))
        writer.mux(stream.encode(None))


def write_times(path: Path, times_ns: Sequence[int]) -> None:
    rows = "".join(f"{index},{t_ns}\n" for index, t_ns in enumerate(times_ns))
    path.write_text("index,unix_ns\n" + rows)


def dataflash_format(kind: int, name: str, letters: str, columns: str) -> bytes:
    sizes = {"B": 1, "h": 2, "H": 2, "I": 4, "f": 4, "L": 4, "Q": 8, "c": 2, "e": 4}
    length = 3 + sum(sizes[letter] for letter in letters)
    body = struct.pack(
        "<BB4s16s64s", kind, length, name.encode(), letters.encode(), columns.encode()
    )
    return b"\xa3\x95\x80" + body


def dataflash_record(kind: int, letters: str, *values: float) -> bytes:
    codes = {"L": "i", "c": "h", "e": "i"}
    form = "<" + "".join(codes.get(letter, letter) for letter in letters)
    return b"\xa3\x95" + bytes([kind]) + struct.pack(form, *values)


def ulog_message(kind: str, body: bytes) -> bytes:
    return struct.pack("<HB", len(body), ord(kind)) + body


def klv(key: str, kind: str, size: int, data: bytes) -> bytes:
    """One GPMF element, padded."""
    count = len(data) // size
    head = key.encode() + kind.encode("latin-1") + bytes([size]) + struct.pack(">H", count)
    return head + data + b"\0" * (-len(data) % 4)
