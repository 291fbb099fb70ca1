"""MAVLink over our own wires, with pymavlink as the codec of single messages."""

from __future__ import annotations

import struct
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.clock import FlightClock
from companion.config import LinkConfig, RouterConfig
from drivers.mavlink_port import OnMessage
from drivers.mavlink_stream import MavlinkStream, decode
from drivers.mavlink_transport import link_wire
from drivers.mavlink_url import link_endpoint

FIRST_SYSTEM = 1
"""What ArduPilot and PX4 are numbered unless somebody changed it."""


class PymavlinkPort:
    """One end of the autopilot's link, which others share through the router.

    ConfigError if the configuration names nothing that can be opened. It begins as a component of
    the configured vehicle, or of system 1; set `identity` when the vehicle has been heard.
    """

    def __init__(self, config: LinkConfig, router: RouterConfig, clock: FlightClock) -> None:
        self._wire = link_wire(link_endpoint(config.url))
        self._stream = MavlinkStream()
        self._codec = mavlink.MAVLink(None)
        self._seqs: dict[tuple[int, int], int] = {}
        self._clock = clock
        self._on_message: OnMessage = lambda message, t_ns: None
        self.name = self._wire.name
        self.identity = (config.system_id or FIRST_SYSTEM, config.component_id)
        self.n_received = 0
        self.n_sent = 0
        self.n_unpacked = 0
        """Messages that could not be packed: a field out of its range."""

    @property
    def connected(self) -> bool:
        """Whether the wire is there."""
        return self._wire.connected

    @property
    def trouble(self) -> str:
        """What is wrong with the wire, in words; "" when nothing is."""
        return self._wire.trouble

    @property
    def n_dropped(self) -> int:
        """Messages that could not be sent."""
        return self._wire.n_dropped + self.n_unpacked

    @property
    def n_bad(self) -> int:
        """Times that the stream of packets was broken."""
        return self._stream.n_breaks

    async def run(self, on_message: OnMessage) -> None:
        """Receive until cancelled."""
        self._on_message = on_message
        await self._wire.run(self)

    def send(self, message: Any) -> None:
        """Pack a message as ours and send it."""
        codec, identity = self._codec, self.identity
        codec.srcSystem, codec.srcComponent = identity
        codec.seq = self._seqs.get(identity, 0)
        try:
            packet = bytes(message.pack(codec))
        except (struct.error, ValueError, TypeError, OverflowError):
            self.n_unpacked += 1
            return
        self._seqs[identity] = (codec.seq + 1) % 256
        self._wire.write(packet)
        self.n_sent += 1

    def opened(self) -> None:
        """See `WireEnd`."""
        self._stream.restart()

    def received(self, data: bytes, monotonic_ns: int) -> int:
        """See `WireEnd`."""
        packets = self._stream.feed(data, monotonic_ns)
        t_ns = self._clock.from_monotonic_ns(monotonic_ns)
        for packet in packets:
            self.n_received += 1
            message = decode(self._codec, packet)
            if message is not None:
                self._on_message(message, t_ns)
        return len(packets)
