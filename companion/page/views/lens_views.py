"""View Lens: the board on this screen or printed, live coverage, the verdict, the calibration."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from companion.errors import CompanionError
from companion.page.background_work import BackgroundWork
from companion.page.views.setting_views import SettingViews
from companion.page.views.site import Form, Site

KIND = "lens"
BOARD = "charuco:7x5:0.04:0.03:DICT_5X5_100"
"""The board of static/board.svg; for the lens the size at which it is shown does not matter."""
FOLDER = "calibrations"
"""Folder beside the file of settings."""
NO_FILE = "companion was started without --config FILE: no calibration can be kept"


class LensViews:
    """See the module."""

    def __init__(self, site: Site, work: BackgroundWork, settings: SettingViews) -> None:
        self._site, self._work, self._settings = site, work, settings

    def routes(self) -> list[Route]:
        """Routes of this view."""
        looking, changing = self._site.looking, self._site.changing
        return [
            Route("/setup/lens", looking(self._show)),
            Route("/setup/lens/panel", looking(self._panel)),
            Route("/setup/lens/begin", changing(self._begin), methods=["POST"]),
            Route("/setup/lens/stop", changing(self._stop), methods=["POST"]),
            Route("/setup/lens/use", changing(self._use), methods=["POST"]),
        ]

    async def _show(self, request: Request) -> Response:
        return await self._site.render(request, "lens.html.j2", **self._values())

    async def _panel(self, request: Request) -> Response:
        return await self._site.render(request, "lens_panel.html.j2", **self._values())

    async def _begin(self, request: Request, form: Form) -> Response:
        folder = self._folder()
        if folder is None:
            return await self._site.refused(request, NO_FILE, 409)
        if self._work.is_busy:
            return await self._site.refused(request, self._work.busy_with, 409)
        board = form.get("board", "").strip() or BOARD
        names = (f"lens-{number}" for number in itertools.count(1))
        name = next(each for each in names if not (folder / f"{each}.toml").exists())
        arguments = ["calibrate", "--running", "--json", "--name", name, "--out", str(folder)]
        self._work.begin(KIND, board, [*arguments, f"--board={board}"], lambda _: None)
        return self._site.done(request, "/setup/lens")

    async def _stop(self, request: Request, form: Form) -> Response:
        self._work.cancel(KIND)
        return self._site.done(request, "/setup/lens", "Stopped: nothing was written.")

    async def _use(self, request: Request, form: Form) -> Response:
        file = self._calibration()
        if file is None:
            return await self._site.refused(request, "There is no calibration yet.", 409)
        try:
            return await self._settings.keep(request, "/setup", {"camera.calibration": file})
        except CompanionError as error:
            return await self._site.refused(request, str(error), 409)

    def _folder(self) -> Path | None:
        path = self._site.facts.path
        return None if path is None else path.parent / FOLDER

    def _calibration(self) -> str | None:
        """File that was written; None where none was."""
        work = self._work.of(KIND)
        found = work.told.get("calibration") if work is not None and work.state == "done" else None
        return str(found) if found else None

    def _values(self) -> dict[str, Any]:
        work = self._work.of(KIND)
        return {
            "work": work, "busy": self._work.is_busy, "board": BOARD, "can_keep": self._folder(),
            "calibration": self._calibration(),
        }  # fmt: skip
