"""The wire to what `link.url` names."""

from __future__ import annotations

from drivers.mavlink_queue import PacketQueue
from drivers.mavlink_udp import UdpWire
from drivers.mavlink_url import Endpoint
from drivers.mavlink_wire import Wire

NETWORK_QUEUE_BYTES = 64_000


def link_wire(endpoint: Endpoint) -> Wire:
    """A wire that is not open yet; `run` opens it."""
    if endpoint.kind in ("udpin", "udpout"):
        queue = PacketQueue(NETWORK_QUEUE_BYTES)
        return UdpWire(endpoint, queue, listens=endpoint.kind == "udpin")
    raise NotImplementedError(endpoint.kind)
