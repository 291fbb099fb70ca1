"""A flight replayed again, with other settings, beside what was made of it in flight."""

from __future__ import annotations

import asyncio
import itertools
import shutil
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from companion.config_file import load_config
from companion.page.background_work import BackgroundWork, Work
from companion.page.flown import FlownFlights
from companion.page.views.site import Form, RefusedError, Site

KIND = "replay"
MOST_LINES = 40


class ReplayViews:
    """See the module. Its results are in folders replay-1, replay-2… of the flight."""

    def __init__(self, site: Site, work: BackgroundWork, flown: FlownFlights) -> None:
        self._site, self._work, self._flown = site, work, flown

    def routes(self) -> list[Route]:
        """Routes of this view."""
        looking, changing = self._site.looking, self._site.changing
        return [
            Route("/flights/{name}/replay/panel", looking(self._panel)),
            Route("/flights/{name}/replay", changing(self._begin), methods=["POST"]),
            Route("/flights/{name}/replay/stop", changing(self._stop), methods=["POST"]),
        ]

    def values(self, name: str) -> dict[str, Any]:
        """Values that the view of a flight needs."""
        work = self._work.of(KIND)
        return {
            "work": work if work is not None and work.about == name else None,
            "busy": self._work.is_busy,
        }

    def is_replayed(self, name: str) -> bool:
        """True while a flight is replayed."""
        work = self._work.of(KIND)
        return self._work.is_busy and work is not None and work.about == name

    async def _panel(self, request: Request) -> Response:
        name = request.path_params["name"]
        return await self._site.render(
            request, "replay_panel.html.j2", name=name, **self.values(name)
        )

    async def _begin(self, request: Request, form: Form) -> Response:
        name = request.path_params["name"]
        settings = [line.strip() for line in form.get("settings", "").splitlines() if line.strip()]
        if form.get("depth") in ("true", "false"):
            settings.append(f"depth.enabled={form['depth']}")
        flight = await asyncio.to_thread(self._flown.one, name)
        load_config(None, settings[:MOST_LINES], lambda _: None)
        if flight.growing or len(settings) > MOST_LINES:
            raise RefusedError(
                "It is still being recorded." if flight.growing else "Too many settings."
            )
        folder = self._flown.folder / name
        out = next(o for k in itertools.count(1) if not (o := folder / f"replay-{k}").exists())
        arguments = ["replay", str(folder), "--out", str(out), "--json"]
        arguments += [f"--set={setting}" for setting in settings]
        self._work.begin(KIND, name, arguments, lambda work: _ended(work, out))
        return self._site.done(request, f"/flights/{name}#again", "It is replayed.")

    async def _stop(self, request: Request, form: Form) -> Response:
        self._work.cancel(KIND)
        name = request.path_params["name"]
        return self._site.done(request, f"/flights/{name}#again", "Stopped: nothing is kept of it.")


def _ended(work: Work, out: Path) -> None:
    """Keep whole results only."""
    if work.state == "done":
        work.told["results"] = out.name
    else:
        shutil.rmtree(out, ignore_errors=True)
