"""MAVLink router: shares the autopilot's link with ground stations, loggers, companions.

Packets of the autopilot and ours go to all clients; a client's packets go to the autopilot, and to
us where addressed to us. Clients do not get each other's.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from companion.config import RouterConfig
from companion.timing.rate_limit import RateLimit
from drivers.mavlink.wire.link_url import client_endpoint
from drivers.mavlink.wire.packet_stream import MavlinkStream, Packet
from drivers.mavlink.wire.send_queue import PacketQueue
from drivers.mavlink.wire.tcp_listener import TcpListener
from drivers.mavlink.wire.tcp_wire import TcpConnection
from drivers.mavlink.wire.udp_wire import UdpWire
from drivers.mavlink.wire.wire import Wire, run_together

CLIENT_BYTES_PER_S, CLIENT_BURST = 50e3, 20e3
INBOX_BYTES = 8000
CLIENT_READ_SIZE = 4096
MOST_GARBAGE = 64_000
MOST_DEPARTED = 16
CLIENTS_SHARE, OWN_SHARE = 0.85, 0.8
"""Clients get the part of the link's rate that we leave, and a twentieth of it at least."""
BURST_S, LEAST_BURST = 0.05, 600
LOOP_NS = 1_000_000_000
AUTOPILOT_NS = 5_000_000_000
AUTOPILOT = 1
TIMESYNC = 111


@dataclass(frozen=True, slots=True)
class ClientCounts:
    """Counters of one client."""

    name: str
    connected: bool
    n_received: int
    n_dropped_out: int
    """Packets to it that were dropped, as it was too slow or not connected."""
    n_dropped_in: int
    """Packets of it that were dropped for lack of capacity of the link."""
    n_bad_bytes: int
    n_refused: int
    """Packets that came back in a loop, used the autopilot's or our identity, gave it another time
    than ours, or lacked the signature."""


class RouterClient:
    """One client: its wire, its counters, and its packets that wait for the link."""

    def __init__(self, router: Router, wire: Wire) -> None:
        self.wire = wire
        self.inbox = PacketQueue(INBOX_BYTES)
        self.n_received = 0
        self.n_refused = 0
        self.stream = MavlinkStream()
        self._router = router
        self._garbage_from = 0
        wire.read_size = CLIENT_READ_SIZE

    def opened(self) -> None:
        """See `WireEnd`."""
        self.stream.restart()
        self._garbage_from = self.stream.n_bad_bytes

    def received(self, data: bytes, monotonic_ns: int) -> int:
        """See `WireEnd`."""
        packets = self.stream.feed(data, monotonic_ns)
        n_known = sum(packet.known for packet in packets)
        self.n_received += len(packets)
        if n_known:
            self._garbage_from = self.stream.n_bad_bytes
        elif self.stream.n_bad_bytes - self._garbage_from > MOST_GARBAGE:
            self.wire.lose("it does not speak MAVLink")
        for packet in packets:
            self._router.from_client(self, packet, monotonic_ns)
        return n_known

    def counts(self) -> ClientCounts:
        """Counters so far."""
        return ClientCounts(
            self.wire.name, self.wire.connected, self.n_received, self.wire.n_dropped,
            self.inbox.n_dropped, self.stream.n_bad_bytes, self.n_refused,
        )  # fmt: skip


class Router:
    """All clients of a link. ConfigError for an invalid URL of a client.

    Clients share the part of the link's rate that we leave, in turn, so that none of them can keep
    us or another from the autopilot.
    """

    def __init__(
        self,
        config: RouterConfig,
        link: Wire,
        identity: Callable[[], tuple[int, int]],
        deliver: Callable[[Packet, int], None],
        accepts: Callable[[Packet, int], bool],
    ) -> None:
        self._link = link
        self._identity = identity
        self.second_component = 0
        """Another component of ours on the same system; 0 for none."""
        self._deliver = deliver
        self._accepts = accepts
        self._queue_bytes = config.queue_kb * 1000
        self._clients: list[RouterClient] = []
        self._listeners: list[TcpListener[RouterClient]] = []
        self._autopilots: dict[int, int] = {}
        self._recent: dict[bytes, tuple[RouterClient | None, int]] = {}
        self._budget = RateLimit(1.0, 1.0)
        self._turns: deque[RouterClient] = deque()
        self._departed: deque[ClientCounts] = deque(maxlen=MOST_DEPARTED)
        self._pump_later: asyncio.TimerHandle | None = None
        for url in config.clients:
            endpoint = client_endpoint(url)
            if endpoint.kind == "tcpin":
                self._listeners.append(TcpListener(endpoint, self._connection, self._leave))
                continue
            queue, limit = PacketQueue(self._queue_bytes), self._read_limit()
            self._join(UdpWire(endpoint, queue, limit, listens=endpoint.kind == "udpin"))

    async def run(self) -> None:
        """Serve the clients until cancelled."""
        fixed = [client.wire.run(client) for client in self._clients]
        try:
            await run_together(*fixed, *(listener.run() for listener in self._listeners))
        finally:
            if self._pump_later is not None:
                self._pump_later.cancel()
                self._pump_later = None

    def counts(self) -> list[ClientCounts]:
        """Counters of the present clients."""
        return [client.counts() for client in self._clients]

    def take_departed(self) -> list[ClientCounts]:
        """Counters of the newest clients that have left since the last call."""
        departed = list(self._departed)
        self._departed.clear()
        return departed

    @property
    def n_rejected(self) -> int:
        """Connections rejected for lack of capacity."""
        return sum(listener.n_rejected for listener in self._listeners)

    @property
    def trouble(self) -> str:
        """Reason why a listener is not open, for people; "" when all are."""
        places = [listener.trouble for listener in self._listeners]
        places += [client.wire.trouble for client in self._clients if not client.wire.connected]
        return "; ".join(place for place in places if place)

    def from_link(self, packets: list[Packet], monotonic_ns: int) -> None:
        """Forward a packet of the autopilot's side."""
        for packet in packets:
            if packet.component == AUTOPILOT and packet.known:
                self._autopilots[packet.system] = monotonic_ns
            self._to_clients(packet.raw, monotonic_ns)

    def from_us(self, raw: bytes) -> None:
        """Forward a packet that we have sent to the autopilot."""
        self._budget.take(OWN_SHARE * len(raw))
        self._to_clients(raw, time.monotonic_ns())

    def from_client(self, client: RouterClient, packet: Packet, monotonic_ns: int) -> None:
        """Forward a packet of a client."""
        if (
            self._goes_in_circles(client, packet, monotonic_ns)
            or _answers_timesync(packet)
            or not self._accepts(packet, monotonic_ns)
        ):
            client.n_refused += 1
            return
        target = packet.target
        if target is not None:
            system, component = self._identity()
            own = (component, self.second_component or component)
            # the autopilot is on the wire: what calls itself that here is not to be believed
            meant = target[0] in (0, system) and target[1] in (0, *own)
            if meant and packet.component != AUTOPILOT:
                self._deliver(packet, monotonic_ns)
                if target[0] == system and target[1] in own:
                    return
        if not client.inbox:
            self._turns.append(client)
        client.inbox.push(packet.raw)
        if self._pump_later is None:
            self._pump()

    def _goes_in_circles(self, client: RouterClient, packet: Packet, monotonic_ns: int) -> bool:
        source = packet.system, packet.component
        system, component = self._identity()
        if source[0] == system and source[1] in (component, self.second_component or component):
            return True
        if packet.component == AUTOPILOT:
            heard_ns = self._autopilots.get(packet.system)
            if heard_ns is not None and monotonic_ns - heard_ns < AUTOPILOT_NS:
                return True
        other, heard_ns = self._recent.get(packet.raw, (client, 0))
        if other is not client and monotonic_ns - heard_ns < LOOP_NS:
            return True
        if len(self._clients) > 1:
            self._remember(packet.raw, client, monotonic_ns)
        return False

    def _to_clients(self, raw: bytes, monotonic_ns: int) -> None:
        if not self._clients:
            return
        self._remember(raw, None, monotonic_ns)
        for client in self._clients:
            client.wire.write(raw)

    def _remember(self, raw: bytes, origin: RouterClient | None, monotonic_ns: int) -> None:
        recent = self._recent
        recent.pop(raw, None)
        recent[raw] = origin, monotonic_ns
        while True:
            oldest = next(iter(recent))
            if monotonic_ns - recent[oldest][1] <= LOOP_NS:
                return
            del recent[oldest]

    def _pump(self) -> None:
        self._pump_later = None
        rate, budget = self._link.bytes_per_s, self._budget
        budget.per_s = max(1.0, CLIENTS_SHARE * rate)
        budget.burst = max(LEAST_BURST, BURST_S * rate)
        budget.left = max(budget.left, -budget.burst)
        budget.refill(time.monotonic_ns())
        while self._turns:
            if budget.left <= 0:
                later = asyncio.get_running_loop().call_later
                self._pump_later = later(budget.wait_s(1.0), self._pump)
                return
            client = self._turns.popleft()
            raw = client.inbox.pop()
            self._link.write(raw)
            budget.take(len(raw))
            if client.inbox:
                self._turns.append(client)

    def _join(self, wire: Wire) -> RouterClient:
        client = RouterClient(self, wire)
        self._clients.append(client)
        return client

    def _connection(self, name: str) -> tuple[TcpConnection, RouterClient]:
        wire = TcpConnection(name, PacketQueue(self._queue_bytes), self._read_limit())
        return wire, self._join(wire)

    def _leave(self, client: RouterClient) -> None:
        self._clients.remove(client)
        self._departed.append(client.counts())
        client.inbox.clear()
        if client in self._turns:
            self._turns.remove(client)

    @staticmethod
    def _read_limit() -> RateLimit:
        return RateLimit(CLIENT_BYTES_PER_S, CLIENT_BURST)


def _answers_timesync(packet: Packet) -> bool:
    """True if an autopilot would set its estimate of this computer's clock by a packet.

    It asks all at once and takes any answer for ours, whose time is in the poses that it gets.
    """
    return packet.known and packet.message_id == TIMESYNC and any(packet.payload[:8])
