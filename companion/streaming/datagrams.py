"""The drone's end of datagrams to viewers: who hears them, and whether they get through."""

from __future__ import annotations

import contextlib
import socket
from dataclasses import dataclass

from companion.streaming.framing import greeted

HEADERS_BYTES = 42
"""Of a datagram: Ethernet, IP and UDP."""
DEAF_AFTER_S = 3.0
"""A viewer that has got none for so long is taken to get none."""


@dataclass(slots=True)
class _Ear:
    address: tuple[str, int]
    n_came: int
    came_s: float


class Datagrams:
    """The UDP side of a port at which viewers connect by TCP."""

    def __init__(self, listener: socket.socket) -> None:
        self.socket = socket.socket(listener.family, socket.SOCK_DGRAM)
        try:
            self.socket.bind(listener.getsockname())
        except OSError:
            self.socket.close()
            raise
        self.socket.setblocking(False)
        self._ears: dict[bytes, _Ear] = {}

    def hear(self, now_s: float, peers: dict[bytes, str]) -> None:
        """Take in what viewers say; `peers` are the addresses from which viewers are connected.

        Whoever is not among them is sent nothing.
        """
        with contextlib.suppress(OSError):
            while True:
                data, address = self.socket.recvfrom(256)
                found = greeted(data)
                if found is None or peers.get(found[0]) != address[0]:
                    continue
                viewer, n_came = found
                before = self._ears.get(viewer)
                gets_any = before is not None and n_came != before.n_came
                came_s = now_s if gets_any or before is None else before.came_s
                self._ears[viewer] = _Ear(address, n_came, came_s)
        self._ears = {viewer: ear for viewer, ear in self._ears.items() if viewer in peers}

    def work(self, viewer: bytes, now_s: float) -> bool:
        """Whether datagrams get through to a viewer."""
        ear = self._ears.get(viewer)
        return ear is not None and ear.n_came > 0 and now_s - ear.came_s < DEAF_AFTER_S

    def is_heard(self, viewer: bytes) -> bool:
        """Whether it is known where to send them."""
        return viewer in self._ears

    def send(self, viewer: bytes, data: bytes) -> int:
        """Send one; how many bytes that takes. Nothing where the network has no room now."""
        try:
            self.socket.sendto(data, self._ears[viewer].address)
        except OSError:
            return 0
        return len(data) + HEADERS_BYTES
