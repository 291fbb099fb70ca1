"""Server that gives each client one short answer.

Few clients at a time, each with a timeout: one that never reads, never asks or never leaves costs
no more than its slot until then.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Awaitable, Callable

from drivers.system.fault_trace import FaultTraces
from drivers.system.within import within

MAX_CLIENTS = 8
MAX_REQUEST = 8192
TIMEOUT_S = 2.0

Answer = Callable[[asyncio.StreamReader], Awaitable[bytes]]
"""Reads the request as far as needed, and returns the answer."""


class ShortAnswers:
    """Answers on a bound socket; runs in the event loop, where `answer` is called.

    `warn` takes faults within `answer` itself; errors of clients are only counted.
    """

    def __init__(
        self, listening: socket.socket, answer: Answer, warn: Callable[[str], None]
    ) -> None:
        self._listening = listening
        self._answer = answer
        self._warn = warn
        self._server: asyncio.AbstractServer | None = None
        self._clients: set[asyncio.Task[None]] = set()
        self._faults = FaultTraces()
        self.n_refused = 0

    async def start(self) -> None:
        """Listen."""
        start = (
            asyncio.start_unix_server
            if self._listening.family == socket.AF_UNIX
            else asyncio.start_server
        )
        self._server = await start(
            self._accept, sock=self._listening, limit=MAX_REQUEST, backlog=MAX_CLIENTS
        )

    async def stop(self) -> None:
        """Stop listening; closes open connections."""
        if self._server is not None:
            self._server.close()
        self._listening.close()
        for client in list(self._clients):
            client.cancel()
        await asyncio.gather(*self._clients, return_exceptions=True)

    def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if len(self._clients) >= MAX_CLIENTS:
            self.n_refused += 1
            writer.transport.abort()
            return
        task = asyncio.ensure_future(self._serve(reader, writer))
        self._clients.add(task)
        task.add_done_callback(self._clients.discard)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            await within(self._reply(reader, writer), TIMEOUT_S)
        except (OSError, EOFError, asyncio.TimeoutError):
            self.n_refused += 1
        except Exception as error:  # a bug in making an answer, which must not end the daemon
            self.n_refused += 1
            self._faults.tell(error)
            self._warn(f"{type(error).__name__}: {error}")
        finally:
            writer.transport.abort()

    async def _reply(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        # With no room beyond the kernel's, draining ends when all has left this process.
        writer.transport.set_write_buffer_limits(0)
        writer.write(await self._answer(reader))
        await writer.drain()
        writer.close()
        await writer.wait_closed()
