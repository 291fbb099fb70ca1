"""The wire to what `link.url` names."""

from __future__ import annotations

from drivers.mavlink_queue import PacketQueue
from drivers.mavlink_serial import SerialWire
from drivers.mavlink_tcp import TcpWire
from drivers.mavlink_udp import UdpWire
from drivers.mavlink_url import Endpoint
from drivers.mavlink_wire import Wire

NETWORK_QUEUE_BYTES = 64_000


def link_wire(endpoint: Endpoint) -> Wire:
    """A wire that is not open yet; `run` opens it."""
    if endpoint.kind == "serial":
        return SerialWire(endpoint)
    queue = PacketQueue(NETWORK_QUEUE_BYTES)
    if endpoint.kind == "tcp":
        return TcpWire(endpoint, queue)
    return UdpWire(endpoint, queue, listens=endpoint.kind == "udpin")
