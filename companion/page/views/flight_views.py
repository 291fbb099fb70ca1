"""View Flights: the list, one flight with its report and downloads, keep and delete."""

from __future__ import annotations

import asyncio
from pathlib import Path
from urllib.parse import quote

from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import Route

from companion.page.flown import SHOWN, FlownFlights
from companion.page.views.replay_views import ReplayViews
from companion.page.views.site import Form, RefusedError, Site

SANDBOX = (
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline' blob:; worker-src blob:;"
    " style-src 'unsafe-inline'; img-src data: blob:; connect-src data: blob:; font-src data:"
)
"""A report is a page of its own, without the session and the network."""
MOST_SHOWN = 200


class FlightViews:
    """See the module."""

    def __init__(self, site: Site, flown: FlownFlights, replays: ReplayViews) -> None:
        self._site, self._flown, self._replays = site, flown, replays

    def routes(self) -> list[Route]:
        """Routes of this view."""
        looking, changing = self._site.looking, self._site.changing
        return [
            Route("/flights", looking(self._list)),
            Route("/flights/{name}", looking(self._one)),
            Route("/flights/{name}/file/{file:path}", looking(self._file)),
            Route("/flights/{name}/keep", changing(self._keep), methods=["POST"]),
            Route("/flights/{name}/release", changing(self._release), methods=["POST"]),
            Route("/flights/{name}/delete", changing(self._delete), methods=["POST"]),
        ]

    async def _list(self, request: Request) -> Response:
        flights = await asyncio.to_thread(self._flown.all)
        free_mb = await asyncio.to_thread(self._flown.free_mb)
        return await self._site.render(
            request, "flights.html.j2", flights=flights[:MOST_SHOWN],
            n_more=max(0, len(flights) - MOST_SHOWN), free_mb=free_mb,
        )  # fmt: skip

    async def _one(self, request: Request) -> Response:
        name = request.path_params["name"]
        flight = await asyncio.to_thread(self._flown.one, name)
        files = await asyncio.to_thread(self._flown.files, name)
        return await self._site.render(
            request, "flight.html.j2", flight=flight, **self._replays.values(name),
            files=[(file, quote(file), mb, SHOWN.get(Path(file).name, "")) for file, mb in files],
        )  # fmt: skip

    async def _file(self, request: Request) -> Response:
        name, file = request.path_params["name"], request.path_params["file"]
        path = await asyncio.to_thread(self._flown.file, name, file)
        if path.suffix == ".html":
            headers = {"Content-Security-Policy": SANDBOX}
            return FileResponse(path, media_type="text/html", headers=headers)
        return FileResponse(
            path, media_type="application/octet-stream", filename=f"{name}-{path.name}"
        )

    async def _keep(self, request: Request, form: Form) -> Response:
        return await self._mark(request, True)

    async def _release(self, request: Request, form: Form) -> Response:
        return await self._mark(request, False)

    async def _mark(self, request: Request, kept: bool) -> Response:
        name = request.path_params["name"]
        await asyncio.to_thread(self._flown.keep, name, kept)
        said = f"{name} is kept." if kept else f"{name} may be deleted when the disk is full."
        return self._site.done(request, f"/flights/{name}", said)

    async def _delete(self, request: Request, form: Form) -> Response:
        name = request.path_params["name"]
        if self._replays.is_replayed(name):
            raise RefusedError(f"{name}: is being replayed")
        await asyncio.to_thread(self._flown.delete, name)
        return self._site.done(request, "/flights", f"{name} was deleted.")
