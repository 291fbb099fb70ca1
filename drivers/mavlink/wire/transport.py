"""Wire of `link.url`."""

from __future__ import annotations

from drivers.mavlink.wire.link_url import Endpoint
from drivers.mavlink.wire.send_queue import PacketQueue
from drivers.mavlink.wire.serial_wire import SerialWire
from drivers.mavlink.wire.tcp_wire import TcpWire
from drivers.mavlink.wire.udp_wire import UdpWire
from drivers.mavlink.wire.wire import Wire

NETWORK_QUEUE_BYTES = 64_000


def link_wire(endpoint: Endpoint) -> Wire:
    """A wire that is not open yet; `run` opens it."""
    if endpoint.kind == "serial":
        return SerialWire(endpoint)
    queue = PacketQueue(NETWORK_QUEUE_BYTES)
    if endpoint.kind == "tcp":
        return TcpWire(endpoint, queue)
    return UdpWire(endpoint, queue, listens=endpoint.kind == "udpin")
