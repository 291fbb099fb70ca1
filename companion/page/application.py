"""The page's ASGI application: all views behind one gate."""

from __future__ import annotations

from collections.abc import Callable
from importlib.resources import files
from pathlib import Path

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from companion.page.access import Access
from companion.page.background_work import BackgroundWork
from companion.page.daemon_watch import DaemonWatch
from companion.page.facts import Facts
from companion.page.flown import FlownFlights
from companion.page.gate import Gate
from companion.page.scene import Scene
from companion.page.views.flight_views import FlightViews
from companion.page.views.lens_views import LensViews
from companion.page.views.mount_views import MountViews
from companion.page.views.now_views import NowViews
from companion.page.views.pairing_views import PairingViews
from companion.page.views.replay_views import ReplayViews
from companion.page.views.rerun_views import RerunViews
from companion.page.views.setting_views import SettingViews
from companion.page.views.setup_views import SetupViews
from companion.page.views.site import Site


def application(
    facts: Facts, watch: DaemonWatch, scene: Scene, clock: Callable[[], float],
    say: Callable[[str], None],
) -> Gate:  # fmt: skip
    """The application; `clock` gives seconds, `say` takes a line for the journal."""
    flights = Path(facts.config.daemon.flights).resolve()
    site = Site(facts, flights, Access(flights, clock, say), watch, scene)
    settings, work, flown = SettingViews(site), BackgroundWork(facts, watch), FlownFlights(flights)
    replays = ReplayViews(site, work, flown)
    routes: list[Route | Mount] = [
        *NowViews(site).routes(),
        *FlightViews(site, flown, replays).routes(),
        *replays.routes(),
        *settings.routes(),
        *SetupViews(site, settings).routes(),
        *LensViews(site, work, settings).routes(),
        *MountViews(site, work, settings).routes(),
        *PairingViews(site).routes(),
        *RerunViews(site).routes(),
        Mount("/static", StaticFiles(directory=str(files("companion.page") / "static"))),
    ]

    async def unknown(request: Request, error: Exception) -> Response:
        if request.headers.get("accept", "").startswith("text/html"):
            return await site.refused(request, "This page has no such view.", 404)
        return PlainTextResponse("there is nothing here", 404)

    async def fault(request: Request, error: Exception) -> Response:
        say(f"the page: {request.url.path}: {type(error).__name__}: {error}")
        return PlainTextResponse("the page has a fault; the journal says which", 500)

    handlers = {404: unknown, Exception: fault}
    return Gate(Starlette(routes=routes, exception_handlers=handlers), clock)
