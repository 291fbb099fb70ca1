"""A view below /setup of work in the background: begun, watched, stopped, its result kept."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from companion.page.background_work import BackgroundWork
from companion.page.views.setting_views import SettingViews
from companion.page.views.site import Form, Site


class WorkViews(ABC):
    """Base class of such views. `kind` is that of the work, and names route and templates."""

    kind: str
    stopped = "Stopped."

    def __init__(self, site: Site, work: BackgroundWork, settings: SettingViews) -> None:
        self._site, self._work, self._settings = site, work, settings
        self._path = f"/setup/{self.kind}"

    def routes(self) -> list[Route]:
        """Routes of this view."""
        looking, changing = self._site.looking, self._site.changing
        return [
            Route(self._path, looking(self._show)),
            Route(f"{self._path}/panel", looking(self._panel)),
            Route(f"{self._path}/begin", changing(self._begin), methods=["POST"]),
            Route(f"{self._path}/stop", changing(self._stop), methods=["POST"]),
            Route(f"{self._path}/use", changing(self._use), methods=["POST"]),
        ]

    @abstractmethod
    def _command(self, form: Form) -> tuple[str, list[str]]:
        """Subject of the work that a form asks for, and its command; RefusedError."""

    @abstractmethod
    async def _use(self, request: Request, form: Form) -> Response:
        """Keep the result in the settings; RefusedError without one."""

    @abstractmethod
    def _values(self) -> dict[str, Any]:
        """Values of the templates, beside the work."""

    async def _show(self, request: Request) -> Response:
        return await self._render(request, f"{self.kind}.html.j2")

    async def _panel(self, request: Request) -> Response:
        return await self._render(request, f"{self.kind}_panel.html.j2")

    async def _render(self, request: Request, template: str) -> Response:
        work, busy = self._work.of(self.kind), self._work.is_busy
        return await self._site.render(request, template, work=work, busy=busy, **self._values())

    async def _begin(self, request: Request, form: Form) -> Response:
        about, arguments = self._command(form)
        self._work.begin(self.kind, about, arguments, lambda _: None)
        return self._site.done(request, self._path)

    async def _stop(self, request: Request, form: Form) -> Response:
        self._work.cancel(self.kind)
        return self._site.done(request, self._path, self.stopped)
