"""The Rerun viewer through the page's own port, and so behind its codes.

Its files and its stream come from the viewer on board (`daemon.viewer = "web"`), which listens on
loopback: those who may look on need no other port. Its page asks for the stream at the root of
whoever served it, by the name of a gRPC service. What it would ask of its makers over the internet
is answered in the browser (`AT_HOME`).
"""

from __future__ import annotations

import re
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING
from urllib.parse import quote

from starlette.background import BackgroundTask
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route

from companion.page.views.site import Site

if TYPE_CHECKING:
    import httpx

    from companion.page.viewer_on_board import ViewerOnBoard

WEB_PORT, GRPC_PORT = 9090, 9876
"""Of the viewer on board."""
SERVICE = re.compile(r"rerun\.[\w.]+")
CONTENT = {
    "Content-Security-Policy": "default-src 'self'; script-src 'self' 'unsafe-inline' "
    "'wasm-unsafe-eval'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "worker-src 'self' blob:; connect-src 'self' data: blob:; object-src 'none'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'"
}
"""Its page has scripts and styles in it, and compiles its program."""
FOREIGN = re.compile(rb"<link[^>]*https://[^>]*>")
"""Fonts from elsewhere: nothing here comes from the internet."""
HEAD = b"<head>"
AT_HOME = b'<script src="/static/viewer_at_home.js"></script>'
"""Before all scripts of the viewer."""
KEPT = "private, max-age=604800"
"""The program is 43 MB; its address names its version."""
PASSED_ON = ("content-type", "grpc-timeout", "x-grpc-web", "x-user-agent", "accept")
PASSED_BACK = ("content-type", "content-length", "rerun-final-length", "grpc-status")
SHORT = 1 << 20
NO_VIEWER = "the Rerun viewer does not run here: daemon.viewer = web"


class RerunViews:
    """See the module."""

    def __init__(self, site: Site) -> None:
        self._site = site
        self._viewer: ViewerOnBoard | None = None
        """Client of the viewer, from the first that looks on: it is 6 MB of memory."""

    def routes(self) -> list[Route]:
        """Routes of this view."""
        looking = self._site.looking
        return [
            Route(f"{viewer_path()}{{file:path}}", looking(self._file)),
            Route("/{service}/{method}", looking(self._stream), methods=["POST"]),
        ]

    async def _file(self, request: Request) -> Response:
        """A file of the viewer."""
        file = quote(request.path_params["file"])
        answer = await self._asked("GET", WEB_PORT, f"/{file}")
        if answer is None:
            return await self._not_there(request)
        headers = _back(answer) | CONTENT
        if "html" not in headers.get("content-type", "") and answer.is_success:
            headers["Cache-Control"] = KEPT
            return _passed(answer, headers)
        try:
            body = FOREIGN.sub(b"", (await answer.aread())[:SHORT])
            body = body.replace(HEAD, HEAD + AT_HOME, 1)
        finally:
            await answer.aclose()
        headers.pop("content-length", None)
        return Response(body, answer.status_code, headers)

    async def _not_there(self, request: Request) -> Response:
        """A page that waits for the viewer, which starts some seconds after the daemon."""
        if not request.headers.get("accept", "").startswith("text/html"):
            return PlainTextResponse(NO_VIEWER, 503)
        if self._site.facts.config.daemon.viewer != "web":
            return await self._site.refused(request, NO_VIEWER, 503)
        return await self._site.render(request, "viewer_waits.html.j2", 202)

    async def _stream(self, request: Request) -> Response:
        """Messages of the flight, as its gRPC service sends them."""
        service, method = request.path_params["service"], request.path_params["method"]
        if not SERVICE.fullmatch(service):
            return PlainTextResponse("there is nothing here", 404)
        headers = {name: request.headers[name] for name in PASSED_ON if name in request.headers}
        answer = await self._asked(
            "POST", GRPC_PORT, f"/{service}/{quote(method)}", headers, await request.body()
        )
        if answer is None:
            return PlainTextResponse(NO_VIEWER, 503)
        return _passed(answer, _back(answer))

    async def _asked(
        self, method: str, port: int, path: str, headers: dict[str, str] | None = None,
        body: bytes = b"",
    ) -> httpx.Response | None:  # fmt: skip
        """Begin of an answer; None where nobody answers."""
        if self._viewer is None:
            from companion.page.viewer_on_board import ViewerOnBoard

            self._viewer = ViewerOnBoard()
        return await self._viewer.asked(method, port, path, headers, body)


def viewer_path() -> str:
    """Path of the viewer's page, which names its version."""
    try:
        return f"/rerun/{version('rerun-sdk')}/"
    except PackageNotFoundError:
        return "/rerun/none/"


def viewer_link(host: str) -> str:
    """Path of the viewer's page with this page's own stream; `host` is HOST:PORT as asked."""
    stream = quote(f"rerun+http://{host}/proxy", safe="")
    return f"{viewer_path()}?url={stream}&theme=dark"


def _back(answer: httpx.Response) -> dict[str, str]:
    return {name: answer.headers[name] for name in PASSED_BACK if name in answer.headers}


def _passed(answer: httpx.Response, headers: dict[str, str]) -> StreamingResponse:
    from companion.page.viewer_on_board import bytes_of

    return StreamingResponse(
        bytes_of(answer), answer.status_code, headers, background=BackgroundTask(answer.aclose)
    )
