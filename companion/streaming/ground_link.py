"""Ground end of a viewer's connection: items as they come, across lost connections.

Items are acknowledged when the consumer has taken them, so that a slow screen slows the sender.
"""

from __future__ import annotations

import os
import select
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, suppress

from companion.errors import StreamError
from companion.streaming.framing import (
    ACKNOWLEDGED,
    HELLO,
    VIEWER_BYTES,
    Reassembly,
    hello_datagram,
)
from companion.streaming.item_codec import decode
from companion.streaming.items import Item, PoseItem
from companion.timing.clock import monotonic_s, wait_s

PORT = 9870
CONNECT_S = 1.0
"""Timeout of an attempt to connect, so that a later one can succeed soon after an outage."""
SILENT_S = 3.0
"""The drone sends twice a second; a connection silent for this long counts as dead."""
ACKNOWLEDGE_EVERY_S, ACKNOWLEDGE_EVERY_BYTES = 0.04, 8192
RECEIVE_BYTES = 65536
HELLO_EVERY_S = 1.0


class GroundLink:
    """Link to the drone of a viewer; `items` gives what comes until `stop` is set.

    `notify` takes the state of the link in words. Without `again` the end of
    the first connection is the end.
    """

    def __init__(
        self, host: str, port: int, notify: Callable[[str], None], again: bool = True
    ) -> None:
        self.host, self.port = host, port
        self._notify, self._again = notify, again
        self._viewer = os.urandom(VIEWER_BYTES)
        self.n_connections = 0
        self.n_bytes = self.n_datagrams = 0
        self._pose_ns = -(2**63)

    def items(self, stop: threading.Event) -> Iterator[Item]:
        """Items of the drone; one is acknowledged when the next one is asked for.

        StreamError for a drone of another protocol.
        """
        is_away = False
        while not stop.is_set():
            try:
                opened = self._connect()
            except OSError as error:
                if not is_away:
                    self._notify(f"waiting for {self.host}:{self.port} ({error.strerror or error})")
                is_away = True
                wait_s(stop, 0.2)
                continue
            self._notify(f"connected to {self.host}:{self.port}")
            is_away = False
            self.n_connections += 1
            with closing(opened), closing(self._datagrams()) as datagrams:
                try:
                    yield from self._received(opened, datagrams, stop)
                except OSError as error:
                    self._notify(f"the link to {self.host} is lost ({error.strerror or error})")
                    if not self._again:
                        return
                    wait_s(stop, 0.2)

    def _connect(self) -> socket.socket:
        opened = socket.create_connection((self.host, self.port), timeout=CONNECT_S)
        opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        opened.sendall(HELLO + self._viewer)
        opened.setblocking(False)
        return opened

    def _datagrams(self) -> socket.socket:
        """Socket for poses by datagram, where possible."""
        found = socket.getaddrinfo(self.host, self.port, type=socket.SOCK_DGRAM)[0]
        opened = socket.socket(found[0], socket.SOCK_DGRAM)
        opened.setblocking(False)
        opened.connect(found[4])
        return opened

    def _poses(self, datagrams: socket.socket) -> Iterator[PoseItem]:
        """Poses that have come by datagram and are the newest."""
        with suppress(OSError):  # nothing more, or nobody there
            while True:
                data = datagrams.recv(256)
                self.n_datagrams += 1
                item = decode(data[0], data[1:]) if data else None
                if isinstance(item, PoseItem) and item.t_ns > self._pose_ns:
                    self._pose_ns = item.t_ns
                    yield item

    def _received(
        self, opened: socket.socket, datagrams: socket.socket, stop: threading.Event
    ) -> Iterator[Item]:
        parts = Reassembly()
        n_taken = n_acknowledged = 0
        heard_s = acknowledged_s = monotonic_s()
        greeted_s = 0.0
        self._pose_ns = -(2**63)
        while not stop.is_set():
            select.select([opened, datagrams], [], [], ACKNOWLEDGE_EVERY_S)
            yield from self._poses(datagrams)
            try:
                data = opened.recv(RECEIVE_BYTES)
            except BlockingIOError:
                data = None
            if data == b"":
                raise ConnectionResetError("closed by the drone")
            now_s = monotonic_s()
            if now_s - greeted_s > HELLO_EVERY_S:
                greeted_s = now_s
                with suppress(OSError):  # nobody hears it, and TCP brings all
                    datagrams.send(hello_datagram(self._viewer, self.n_datagrams))
            if data is not None:
                heard_s = now_s
                for kind, payload in parts.take(data):
                    item = decode(kind, payload) if kind != 0 else None
                    if isinstance(item, PoseItem):
                        if item.t_ns <= self._pose_ns:
                            continue  # a newer one has come already
                        self._pose_ns = item.t_ns
                    if item is not None:
                        yield item
                        yield from self._poses(datagrams)
                n_taken += len(data)
                self.n_bytes += len(data)
                now_s = monotonic_s()
            elif now_s - heard_s > SILENT_S:
                raise TimeoutError("nothing has come for a while")
            n_new = n_taken - n_acknowledged
            if n_new and (
                n_new >= ACKNOWLEDGE_EVERY_BYTES
                or now_s - acknowledged_s >= ACKNOWLEDGE_EVERY_S
                or data is None
            ):
                opened.sendall(ACKNOWLEDGED.pack(n_taken))
                n_acknowledged, acknowledged_s = n_taken, now_s


def host_and_port(text: str) -> tuple[str, int]:
    """HOST or HOST:PORT; StreamError for anything else."""
    host, colon, port = text.rpartition(":")
    if not colon or "]" in port:
        host, port = text, str(PORT)
    if not host or "/" in host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise StreamError(f"{text}: wanted HOST or HOST:PORT")
    return host.strip("[]"), int(port)
