"""MAVLink port without a wire: a test gives its input, and reads its output."""

from __future__ import annotations

import asyncio
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drivers.mavlink.wire.message_port import OnMessage
from drivers.mavlink.wire.router import ClientCounts
from drivers.mavlink.wire.wire import Tap


class MemoryPort:
    """A `MavlinkPort` that is always connected."""

    def __init__(self) -> None:
        self.name = "memory"
        self.identity = (0, 0)
        self.second_component = 0
        self.sent_as_second: list[Any] = []
        self.connected, self.trouble = True, ""
        self.capacity_bytes_per_s: float | None = None
        self.n_received = self.n_sent = self.n_dropped = self.n_bad = 0
        self.sent: list[Any] = []
        self._on_message: OnMessage | None = None
        self._codec = mavlink.MAVLink(None)

    async def run(self, on_message: OnMessage) -> None:
        self._on_message = on_message
        await asyncio.Event().wait()

    def clients(self) -> list[ClientCounts]:
        return []

    def set_tap(self, tap: Tap | None) -> None:
        """There are no bytes to be told of."""

    def send(self, message: Any, as_second: bool = False) -> None:
        message.pack(self._codec)  # fails where a field is out of its range
        (self.sent_as_second if as_second else self.sent).append(message)
        self.n_sent += 1

    def hear(self, message: Any, t_ns: int, system: int = 1, component: int = 1) -> None:
        """A message came at a time of the flight."""
        speaker = mavlink.MAVLink(None, system, component)
        [whole] = self._codec.parse_buffer(bytearray(message.pack(speaker)))
        self.n_received += 1
        assert self._on_message is not None
        self._on_message(whole, t_ns)

    def of(self, kind: str) -> list[Any]:
        """What was sent of a kind."""
        return [message for message in self.sent if message.get_type() == kind]
