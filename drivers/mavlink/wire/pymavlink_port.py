"""MAVLink over our own wires, with pymavlink as the codec of single messages."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.config import LinkConfig, RouterConfig
from companion.timing.clock import FlightClock
from drivers.mavlink.wire.link_url import link_endpoint
from drivers.mavlink.wire.message_port import OnMessage
from drivers.mavlink.wire.packet_stream import MavlinkStream, Packet, decode
from drivers.mavlink.wire.router import ClientCounts, Router
from drivers.mavlink.wire.signing import MavlinkSigning, read_key
from drivers.mavlink.wire.transport import link_wire
from drivers.mavlink.wire.wire import Tap, Wire, run_together

FIRST_SYSTEM = 1
"""Default system id of ArduPilot and PX4."""
BEAT = mavlink.MAVLINK_MSG_ID_HEARTBEAT
MANY_REFUSED = 10


class PymavlinkPort:
    """One end of the autopilot's link, which others share through the router.

    ConfigError for an invalid URL or key. It begins as a component of the configured vehicle, or of
    system 1; set `identity` when the vehicle has been heard. With a key only signed messages are
    delivered, and clients of the router must sign their messages as well; they get the autopilot's
    unchanged.
    """

    def __init__(
        self, config: LinkConfig, router: RouterConfig, clock: FlightClock, wire: Wire | None = None
    ) -> None:
        self._wire = link_wire(link_endpoint(config.url)) if wire is None else wire
        self.name = self._wire.name
        self.identity = (config.system_id or FIRST_SYSTEM, config.component_id)
        self.router = Router(
            router, self._wire, lambda: self.identity, self._deliver, self._is_signed
        )
        self.n_received = 0
        self.n_sent = 0
        self.n_unsigned = 0
        """Packets of the link rejected without a valid signature."""
        self._n_unpacked = 0
        self._unpacked = ""
        """The newest message with a field out of its range, and what is wrong with it."""
        self._n_refused = 0
        """Part of `n_unsigned` since the last valid one."""
        self._clock = clock
        self._stream = MavlinkStream()
        self._reader = mavlink.MAVLink(None)
        self._writer = mavlink.MAVLink(None)
        self._signing: MavlinkSigning | None = None
        if config.signing_key_file:
            self._signing = MavlinkSigning(read_key(Path(config.signing_key_file)))
            self._writer.signing.secret_key = self._signing.key
            self._writer.signing.sign_outgoing = True
        self._seq_out: dict[tuple[int, int], int] = {}
        self._on_message: OnMessage = _ignore

    @property
    def connected(self) -> bool:
        """True while the wire is open."""
        return self._wire.connected

    @property
    def capacity_bytes_per_s(self) -> float | None:
        """See `MavlinkPort`."""
        return self._wire.bytes_per_s if self._wire.is_line else None

    @property
    def trouble(self) -> str:
        """Problem of the wire, of what is sent or of the router's listeners; "" without one."""
        keyless = ""
        if self._n_refused > MANY_REFUSED:
            keyless = f"{self.name}: what comes is not signed with the key of link.signing_key_file"
        unpacked = f"not sent ({self._n_unpacked}): {self._unpacked}" if self._unpacked else ""
        troubles = self._wire.trouble, keyless, unpacked, self.router.trouble
        return "; ".join(trouble for trouble in troubles if trouble)

    @property
    def n_dropped(self) -> int:
        """Messages not sent: no wire, no capacity, or a field out of range; clients' ones too."""
        return self._wire.n_dropped + self._n_unpacked

    @property
    def n_bad(self) -> int:
        """Breaks of the packet stream, and packets without a valid signature where required."""
        return self._stream.n_breaks + self.n_unsigned

    def clients(self) -> list[ClientCounts]:
        """See `MavlinkPort`."""
        return self.router.take_departed() + self.router.counts()

    def set_tap(self, tap: Tap | None) -> None:
        """See `MavlinkPort`."""
        self._wire.tap = tap

    async def run(self, on_message: OnMessage) -> None:
        """Receive, and serve the router's clients, until cancelled."""
        self._on_message = on_message
        try:
            await run_together(self._wire.run(self), self.router.run())
        finally:
            self._on_message = _ignore

    @property
    def second_component(self) -> int:
        """See `MavlinkPort`."""
        return self.router.second_component

    @second_component.setter
    def second_component(self, component: int) -> None:
        self.router.second_component = component

    def send(self, message: Any, as_second: bool = False) -> None:
        """Pack a message as ours, signed if there is a key, and send it."""
        writer, identity = self._writer, self.identity
        if as_second:
            identity = (identity[0], self.second_component)
        writer.srcSystem, writer.srcComponent = identity
        writer.seq = self._seq_out.get(identity, 0)
        if self._signing is not None:
            writer.signing.timestamp = self._signing.next_stamp(self._clock.now_ns())
        try:
            raw = bytes(message.pack(writer))
        except (struct.error, ValueError, TypeError, OverflowError, AttributeError) as error:
            self._n_unpacked += 1
            self._unpacked = f"{type(message).__name__}: {error}"
            return
        self._seq_out[identity] = (writer.seq + 1) % 256
        self._wire.write(raw)
        self.router.from_us(raw)
        self.n_sent += 1

    def opened(self) -> None:
        """See `WireEnd`."""
        self._stream.restart()

    def received(self, data: bytes, monotonic_ns: int) -> int:
        """See `WireEnd`."""
        ours = self.identity
        packets = self._stream.feed(data, monotonic_ns)
        if any((packet.system, packet.component) == ours for packet in packets):
            # echoes of our own packets, of a wire whose ends are joined: not passed on
            beats = [p for p in packets if (p.system, p.component, p.message_id) == (*ours, BEAT)]
            packets = [packet for packet in packets if (packet.system, packet.component) != ours]
            for beat in beats:  # or of another companion
                if self._is_signed(beat, monotonic_ns):
                    self._deliver(beat, monotonic_ns)
        self.n_received += len(packets)
        try:
            for packet in packets:
                if self._is_signed(packet, monotonic_ns):
                    self._n_refused = 0
                    self._deliver(packet, monotonic_ns)
                else:
                    self._n_refused += 1
                    self.n_unsigned += 1
        finally:
            self.router.from_link(packets, monotonic_ns)
        return sum(packet.known for packet in packets)

    def _is_signed(self, packet: Packet, monotonic_ns: int) -> bool:
        """True if a packet is signed with the key, or no key is required."""
        if self._signing is None:
            return True
        return self._signing.accepts(packet, self._clock.from_monotonic_ns(monotonic_ns))

    def _deliver(self, packet: Packet, monotonic_ns: int) -> None:
        message = decode(self._reader, packet)
        if message is not None:
            self._on_message(message, self._clock.from_monotonic_ns(monotonic_ns))


def _ignore(message: Any, t_ns: int) -> None:
    """Sink of messages while nobody receives."""
