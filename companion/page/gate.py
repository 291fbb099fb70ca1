"""Gate before all requests: rates, sizes, names of this machine, and headers of answers."""

from __future__ import annotations

import asyncio
import ipaddress
import socket
from collections.abc import Callable, Mapping
from typing import Any

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from companion.page.access import MOST_PEERS, is_here
from companion.timing.rate_limit import PeerLimit

MOST_BODY_BYTES = 65536
"""The longest form is that of all settings, some 10 kB."""
ONE_PEER, ALL_PEERS = (60.0, 120.0), (120.0, 240.0)
"""Requests a second, and at once: an open view asks seven times a second, and loads four files."""
REFUSED_S = 1.0
"""Time until a request too many is refused: who waits for the answer asks no sooner again."""
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data: blob:; object-src 'none'; "
    "base-uri 'none'; form-action 'self'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}

STATIC = "/static/"
STATIC_HEADERS = {**HEADERS, "Cache-Control": "no-cache"}
"""Style and script are kept by the browser, which asks whether they are still the same."""


class Gate:
    """ASGI application around the page's own; `clock` gives seconds."""

    def __init__(self, inner: ASGIApp, clock: Callable[[], float]) -> None:
        self._inner, self._clock = inner, clock
        self._requests = PeerLimit(ONE_PEER, ALL_PEERS, MOST_PEERS)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request through, or refuse it."""
        if scope["type"] != "http":
            return
        headers, peer = Headers(scope=scope), (scope.get("client") or ("",))[0]
        if not self._requests.allows(peer, round(self._clock() * 1e9)):
            await asyncio.sleep(REFUSED_S)
            answer = PlainTextResponse("too many requests", 429, {"Retry-After": "2"})
        elif not _is_short(headers):
            answer = PlainTextResponse("longer than any form here", 413, {"Connection": "close"})
        elif is_here(peer) and not is_own_name(headers.get("host", "")):
            # a page elsewhere whose name leads here: it would be taken for somebody on this machine
            answer = PlainTextResponse("ask by an address of this machine, not by this name", 421)
        else:
            own = STATIC_HEADERS if scope["path"].startswith(STATIC) else HEADERS
            await self._inner(scope, _bounded(receive), _with_headers(send, own))
            return
        await answer(scope, receive, _with_headers(send, HEADERS))


def is_own_name(host: str) -> bool:
    """True of an address, and of the names that this machine itself has."""
    name = host.rpartition(":")[0] if not host.endswith("]") and ":" in host else host
    name = name.strip("[]").lower().rstrip(".")
    own = socket.gethostname().lower()
    if name in ("localhost", own, f"{own}.local"):
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _is_short(headers: Headers) -> bool:
    length = headers.get("content-length", "0")
    return length.isdecimal() and int(length) <= MOST_BODY_BYTES


def _bounded(receive: Receive) -> Receive:
    n_bytes = 0

    async def bounded() -> Message:
        nonlocal n_bytes
        message = await receive()
        n_bytes += len(message.get("body", b""))
        if n_bytes > MOST_BODY_BYTES:
            return {"type": "http.disconnect"}
        return message

    return bounded


def _with_headers(send: Send, headers_wanted: Mapping[str, str]) -> Send:
    async def sending(message: Any) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in headers_wanted.items():
                headers.setdefault(name, value)
        await send(message)

    return sending
