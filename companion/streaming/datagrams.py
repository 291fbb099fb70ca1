"""On-board end of datagrams to viewers: their addresses, and whether datagrams get through."""

from __future__ import annotations

import contextlib
import socket
from dataclasses import dataclass

from companion.streaming.framing import read_hello

HEADERS_BYTES = 42
"""Headers of a datagram: Ethernet, IP and UDP."""
UNREACHABLE_AFTER_S = 3.0
"""A viewer that has received none for this long counts as unreachable by datagram."""


@dataclass(slots=True)
class _Peer:
    address: tuple[str, int]
    n_received: int
    received_s: float


class Datagrams:
    """UDP side of a port at which viewers connect by TCP."""

    def __init__(self, listener: socket.socket) -> None:
        self.socket = socket.socket(listener.family, socket.SOCK_DGRAM)
        try:
            self.socket.bind(listener.getsockname())
        except OSError:
            self.socket.close()
            raise
        self.socket.setblocking(False)
        self._peers: dict[bytes, _Peer] = {}

    def receive(self, now_s: float, peers: dict[bytes, str]) -> None:
        """Receive from viewers; `peers` are the addresses from which viewers are connected.

        Anybody else is sent nothing.
        """
        with contextlib.suppress(OSError):
            while True:
                data, address = self.socket.recvfrom(256)
                found = read_hello(data)
                if found is None or peers.get(found[0]) != address[0]:
                    continue
                viewer, n_received = found
                before = self._peers.get(viewer)
                gets_any = before is not None and n_received != before.n_received
                received_s = now_s if gets_any or before is None else before.received_s
                self._peers[viewer] = _Peer(address, n_received, received_s)
        self._peers = {viewer: peer for viewer, peer in self._peers.items() if viewer in peers}

    def get_through(self, viewer: bytes, now_s: float) -> bool:
        """True while datagrams of a viewer arrive; `now_s` is monotonic time."""
        peer = self._peers.get(viewer)
        return (
            peer is not None
            and peer.n_received > 0
            and now_s - peer.received_s < UNREACHABLE_AFTER_S
        )

    def has_peer(self, viewer: bytes) -> bool:
        """True if a viewer's address is known."""
        return viewer in self._peers

    def send(self, viewer: bytes, data: bytes) -> int:
        """Send one; its size in bytes. Nothing where the network has no capacity now."""
        try:
            self.socket.sendto(data, self._peers[viewer].address)
        except OSError:
            return 0
        return len(data) + HEADERS_BYTES
