"""TCP listener of the router."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

from companion.errors import SourceError
from drivers.mavlink.wire.host_address import resolve
from drivers.mavlink.wire.link_url import Endpoint
from drivers.mavlink.wire.tcp_wire import SEND_BUFFER, TcpConnection
from drivers.mavlink.wire.wire import FIRST_RETRY_S, MOST_RETRY_S, WireEnd

MOST_CONNECTIONS = 8
ACCEPT_S = 0.02
"""Least interval of accepted connections, against clients that reconnect in a loop."""
BACKLOG = 32


class ClientEnd(WireEnd, Protocol):
    """The router's end of a connection."""

    n_received: int


AnyClient = TypeVar("AnyClient", bound=ClientEnd)


class TcpListener(Generic[AnyClient]):
    """Listens at an endpoint; `admit` makes wire and end of a connection, `leave` removes them.

    When all connections are in use, the oldest that has never sent a packet is closed for a new
    one; if all have, the new one is rejected.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        admit: Callable[[str], tuple[TcpConnection, AnyClient]],
        leave: Callable[[AnyClient], None],
    ) -> None:
        self.name = str(endpoint)
        self.trouble = ""
        self.port = 0
        """Port in use; 0 while it does not listen."""
        self.n_rejected = 0
        self._endpoint = endpoint
        self._admit = admit
        self._leave = leave
        self._clients: dict[asyncio.Task[None], tuple[TcpConnection, AnyClient]] = {}

    async def run(self) -> None:
        """Accept clients until cancelled."""
        retry_s = FIRST_RETRY_S
        try:
            while True:
                try:
                    listener = await self._listen()
                except SourceError as error:
                    self.trouble = str(error)
                    await asyncio.sleep(retry_s)
                    retry_s = min(2 * retry_s, MOST_RETRY_S)
                    continue
                retry_s = FIRST_RETRY_S
                with listener:
                    await self._accept_clients(listener)
        finally:
            self.port = 0
            for task in list(self._clients):
                task.cancel()
            await asyncio.gather(*self._clients, return_exceptions=True)

    async def _listen(self) -> socket.socket:
        family, address = await resolve(self._endpoint.host, self._endpoint.port)
        listener = socket.socket(family, socket.SOCK_STREAM)
        try:
            listener.setblocking(False)
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)  # is inherited
            listener.bind(address)
            listener.listen(BACKLOG)
        except OSError as error:
            listener.close()
            raise SourceError(f"{self.name}: {error.strerror}") from error
        self.port = int(listener.getsockname()[1])
        self.trouble = ""
        return listener

    async def _accept_clients(self, listener: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                connected, address = await loop.sock_accept(listener)
            except OSError as error:  # no more files may be open, say
                self.trouble = f"{self.name}: {error.strerror}"
                await asyncio.sleep(MOST_RETRY_S)
                continue
            self.trouble = ""
            self._admit_client(connected, f"{self.name} from {address[0]}:{address[1]}")
            await asyncio.sleep(ACCEPT_S)

    def _admit_client(self, connected: socket.socket, name: str) -> None:
        if len(self._clients) >= MOST_CONNECTIONS and not self._close_idle():
            self.n_rejected += 1
            connected.close()
            return
        wire, client = self._admit(name)
        try:
            fd = wire.take(connected)
        except OSError:  # it has gone already
            connected.close()
            self._leave(client)
            return
        task = asyncio.get_running_loop().create_task(wire.serve(fd, client))
        self._clients[task] = wire, client
        task.add_done_callback(self._closed)

    def _close_idle(self) -> bool:
        for wire, client in self._clients.values():
            if wire.connected and client.n_received == 0:
                self.n_rejected += 1
                wire.lose("made room for another")
                return True
        return False

    def _closed(self, task: asyncio.Task[None]) -> None:
        _, client = self._clients.pop(task)
        self._leave(client)
