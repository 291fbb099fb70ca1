"""HTTP server whose connections are bounded in number, time and bytes."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections import Counter
from collections.abc import Iterator
from typing import Any

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

MOST_CONNECTIONS, MOST_OF_ONE_PEER = 64, 40
"""A browser opens six. More are closed at once: a few phones and tablets look on, no crowd."""
REQUEST_S = 10.0
"""Time for a whole request to come, from its connection or its first byte on."""
NOT_TAKEN_S = 20.0
"""Time for which a peer may take nothing of an answer."""
KEEP_ALIVE_S = 15
HEAD_BYTES = 16384
REFUSED_S = 1.0
"""Time for which a connection that brought no request is kept, unread: who sends rubbish without
end is held by the flow control of TCP, instead of being refused anew a hundred times a second."""
REFUSAL = (
    b"HTTP/1.1 400 Bad Request\r\nContent-Type: text/plain\r\nConnection: close\r\n\r\n"
    b"this is no request"
)
_open: Counter[str] = Counter()
"""Connections by peer."""


class BoundedConnection(H11Protocol):
    """A connection that ends when its peer asks too slowly, or does not take the answer."""

    _request_due: asyncio.TimerHandle | None = None
    _answer_due: asyncio.TimerHandle | None = None
    _refused_until: asyncio.TimerHandle | None = None
    _counted = ""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Count it, and wait for the request; closed at once where there are too many."""
        peer = (transport.get_extra_info("peername") or ("",))[0]
        if _open.total() >= MOST_CONNECTIONS or _open[peer] >= MOST_OF_ONE_PEER:
            super().connection_made(transport)
            transport.abort()
            return
        self._counted = peer
        _open[peer] += 1
        super().connection_made(transport)
        self._await_request()

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget it."""
        if self._counted:
            _open[self._counted] -= 1
            if not _open[self._counted]:
                del _open[self._counted]
            self._counted = ""
        self._request_came()
        self._answer_taken()
        if self._refused_until is not None:
            self._refused_until.cancel()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Take bytes of a request."""
        if self._request_due is None and self.conn.their_state is h11.IDLE:
            self._await_request()
        super().data_received(data)
        if self.conn.their_state not in (h11.IDLE, h11.SEND_BODY):
            self._request_came()

    def send_400_response(self, msg: str) -> None:
        """Refuse what is no request, and read no more of it."""
        self.transport.pause_reading()
        self.transport.write(REFUSAL)
        self._refused_until = self.loop.call_later(REFUSED_S, self.transport.abort)

    def pause_writing(self) -> None:
        """The peer does not take the answer as fast as it is made."""
        super().pause_writing()
        if self._answer_due is None:
            self._answer_due = self.loop.call_later(NOT_TAKEN_S, self.transport.abort)

    def resume_writing(self) -> None:
        """The peer has taken most of it."""
        self._answer_taken()
        super().resume_writing()

    def _await_request(self) -> None:
        self._request_due = self.loop.call_later(REQUEST_S, self.transport.abort)

    def _request_came(self) -> None:
        if self._request_due is not None:
            self._request_due.cancel()
            self._request_due = None

    def _answer_taken(self) -> None:
        if self._answer_due is not None:
            self._answer_due.cancel()
            self._answer_due = None


class BoundedServer(uvicorn.Server):
    """Server that leaves signals to its process."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Leave signals alone."""
        yield


def bounded_server(application: Any) -> BoundedServer:
    """Server of an ASGI application; `serve(sockets=[…])` runs it."""
    logging.getLogger("uvicorn").setLevel(logging.CRITICAL)  # a line for each piece of rubbish
    return BoundedServer(
        uvicorn.Config(
            application, http=BoundedConnection, ws="none", lifespan="off", loop="asyncio",
            log_config=None, access_log=False, proxy_headers=False, server_header=False,
            date_header=False, timeout_keep_alive=KEEP_ALIVE_S, timeout_graceful_shutdown=1,
            h11_max_incomplete_event_size=HEAD_BYTES, backlog=32,
        )
    )  # fmt: skip
