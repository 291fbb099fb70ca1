"""Packets for tests of the MAVLink link, and waiting for their effects."""

from __future__ import annotations

import asyncio
import contextlib
import random
import struct
from collections.abc import AsyncIterator, Coroutine
from dataclasses import dataclass, field
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink
from pymavlink.generator.mavcrc import x25crc

from companion.config import LinkConfig, RouterConfig
from companion.timing.clock import FlightClock
from drivers.mavlink.wire.packet_stream import MavlinkStream, Packet
from drivers.mavlink.wire.pymavlink_port import PymavlinkPort

UNKNOWN_ID = 54321
UNKNOWN_EXTRA = 77


class Speaker:
    """Packs messages as one component does."""

    def __init__(self, system: int = 1, component: int = 1, key: bytes | None = None) -> None:
        self._codec = mavlink.MAVLink(None, system, component)
        if key is not None:
            self._codec.signing.secret_key = key
            self._codec.signing.sign_outgoing = True

    def pack(self, message: Any, stamp: int | None = None, v1: bool = False) -> bytes:
        if stamp is not None:
            self._codec.signing.timestamp = stamp
        raw = bytes(message.pack(self._codec, force_mavlink1=v1))
        self._codec.seq = (self._codec.seq + 1) % 256
        return raw

    def attitude(self, boot_ms: int, v1: bool = False) -> bytes:
        return self.pack(attitude(boot_ms), v1=v1)

    def heartbeat(self) -> bytes:
        return self.pack(heartbeat())


def attitude(boot_ms: int) -> Any:
    return mavlink.MAVLink_attitude_message(boot_ms, 0.1, -0.2, 0.3, 0.01, 0.02, 0.03)


def heartbeat() -> Any:
    return mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)


def command(system: int, component: int, number: int = 512) -> Any:
    return mavlink.MAVLink_command_long_message(system, component, number, 0, *[1.0] * 7)


def unknown(
    seq: int, message_id: int = UNKNOWN_ID, extra: int = UNKNOWN_EXTRA, n: int = 20
) -> bytes:
    """A MAVLink 2 packet of a message that no dialect here knows."""
    payload = random.Random(seq).randbytes(n - 1) + b"\x01"
    body = struct.pack("<BBBBBB", n, 0, 0, seq % 256, 9, 8) + message_id.to_bytes(3, "little")
    body += payload
    return b"\xfd" + body + struct.pack("<H", x25crc(body + bytes([extra])).crc)


def split(data: bytes) -> list[Packet]:
    """The packets of what somebody got; fails if anything else is in it."""
    stream = MavlinkStream()
    packets = stream.feed(data, 0)
    assert stream.n_bad_bytes == 0
    return packets


@dataclass
class Ear:
    """Our end of a wire, that only listens."""

    data: bytearray = field(default_factory=bytearray)
    times_ns: list[int] = field(default_factory=list)
    n_opened: int = 0
    stream: MavlinkStream = field(default_factory=MavlinkStream)
    packets: list[Packet] = field(default_factory=list)

    def opened(self) -> None:
        self.n_opened += 1
        self.stream.restart()

    def received(self, data: bytes, monotonic_ns: int) -> int:
        self.data += data
        self.times_ns.append(monotonic_ns)
        packets = self.stream.feed(data, monotonic_ns)
        self.packets += packets
        return sum(packet.known for packet in packets)


@contextlib.asynccontextmanager
async def running(work: Coroutine[Any, Any, None]) -> AsyncIterator[asyncio.Task[None]]:
    """Something that runs until the end of the block; what fails in it fails the test."""
    loop = asyncio.get_running_loop()
    failures: list[object] = []
    if loop.get_exception_handler() is None:
        loop.set_exception_handler(lambda _, what: failures.append(what))
    task = asyncio.ensure_future(work)
    await asyncio.sleep(0)
    try:
        yield task
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
        assert failures == []


class Heard:
    """What a port delivered."""

    def __init__(self) -> None:
        self.messages: list[Any] = []
        self.times_ns: list[int] = []

    def __call__(self, message: Any, t_ns: int) -> None:
        self.messages.append(message)
        self.times_ns.append(t_ns)

    def of(self, kind: str) -> list[Any]:
        return [message for message in self.messages if message.get_type() == kind]


def port_at(
    url: str, clients: tuple[str, ...] = (), queue_kb: int = 256, key_file: str = "", **link: Any
) -> PymavlinkPort:
    return PymavlinkPort(
        LinkConfig(url=url, signing_key_file=key_file, **link),
        RouterConfig(clients=clients, queue_kb=queue_kb),
        FlightClock(),
    )
