"""The viewer on board, as the page asks it: loopback, as a stream, one connection for each."""

from __future__ import annotations

from collections.abc import AsyncIterator

import httpx

LOOPBACK = "127.0.0.1"
CONNECT_S = 3.0


class ViewerOnBoard:
    """Client of the viewer's two ports."""

    def __init__(self) -> None:
        timeout = httpx.Timeout(None, connect=CONNECT_S)  # a stream may be silent
        once = httpx.Limits(max_keepalive_connections=0)
        self._client = httpx.AsyncClient(timeout=timeout, limits=once, trust_env=False)

    async def asked(
        self, method: str, port: int, path: str, headers: dict[str, str] | None = None,
        body: bytes = b"",
    ) -> httpx.Response | None:  # fmt: skip
        """Begin of an answer; None where nobody answers."""
        request = self._client.build_request(
            method, f"http://{LOOPBACK}:{port}{path}", headers=headers, content=body
        )
        try:
            return await self._client.send(request, stream=True)
        except httpx.HTTPError:
            return None


async def bytes_of(answer: httpx.Response) -> AsyncIterator[bytes]:
    """Bytes as they come, no faster than the browser takes them."""
    try:
        async for data in answer.aiter_raw():
            yield data
    except httpx.HTTPError:
        pass  # the viewer has ended, and with it the stream
    finally:
        await answer.aclose()
