"""MAVLink over TCP."""

from __future__ import annotations

import asyncio
import os
import socket
import time

from companion.errors import SourceError
from companion.timing.rate_limit import RateLimit
from drivers.mavlink.wire.host_address import resolve
from drivers.mavlink.wire.link_url import Endpoint
from drivers.mavlink.wire.send_queue import PacketQueue
from drivers.mavlink.wire.udp_wire import NETWORK_BYTES_PER_S
from drivers.mavlink.wire.wire import Wire

CONNECT_S = 2.0
UNANSWERED_MS = 3000
SEND_BUFFER = 65536
"""Small, so that packets wait in our queue, where the oldest can be dropped."""


class TcpConnection(Wire):
    """Accepted connection; `run` it through `serve` with a connected socket."""

    def __init__(self, name: str, queue: PacketQueue, read_limit: RateLimit | None = None) -> None:
        super().__init__(name, NETWORK_BYTES_PER_S, queue, read_limit)
        self._socket: socket.socket | None = None

    def take(self, connected: socket.socket) -> int:
        """Use a connected socket; returns its file descriptor for `serve`."""
        self._socket = connected
        connected.setblocking(False)
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connected.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        # a cable that was pulled says nothing: only the silence after what we send tells
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, UNANSWERED_MS)
        return connected.fileno()

    async def _open(self) -> int:
        raise SourceError(f"{self.name}: the connection has ended")

    def _close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _read(self) -> tuple[bytes, int]:
        assert self._socket is not None
        data = self._socket.recv(self.read_size)
        if not data:
            raise EOFError
        return data, time.monotonic_ns()

    def _write(self, data: bytes) -> int:
        assert self._socket is not None
        return self._socket.send(data)


class TcpWire(TcpConnection):
    """TCP to a server, reconnected whenever it is lost."""

    def __init__(self, endpoint: Endpoint, queue: PacketQueue) -> None:
        super().__init__(str(endpoint), queue)
        self._endpoint = endpoint

    async def _open(self) -> int:
        family, address = await resolve(self._endpoint.host, self._endpoint.port)
        opened = socket.socket(family, socket.SOCK_STREAM)
        try:
            opened.setblocking(False)
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
            await self._connect(opened, address)
            return self.take(opened)
        except SourceError:
            opened.close()
            raise
        except OSError as error:
            opened.close()
            reason = os.strerror(error.errno) if error.errno else str(error)
            raise SourceError(f"{self.name}: {reason}") from error
        except asyncio.CancelledError:
            opened.close()
            raise

    async def _connect(self, opened: socket.socket, address: tuple[str, int]) -> None:
        loop = asyncio.get_running_loop()
        connecting = asyncio.ensure_future(loop.sock_connect(opened, address))
        try:
            # not wait_for: up to Python 3.11 it swallows a cancellation that comes with the answer
            await asyncio.wait({connecting}, timeout=CONNECT_S)
            if not connecting.done():
                raise SourceError(f"{self.name}: no answer")
            connecting.result()
        finally:
            if connecting.cancel():
                await asyncio.wait({connecting})
