"""View Mount: the vehicle is turned by hand, and the mount found of the rotations."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from companion.errors import CompanionError
from companion.page.background_work import BackgroundWork
from companion.page.views.setting_views import SettingViews
from companion.page.views.site import Form, Site
from drivers.images.calibration_file import read_calibration

KIND = "mount"
ANGLES = ("roll_deg", "pitch_deg", "yaw_deg")
ENOUGH_DEG = 30.0
"""Range of each angle that the search wants, for its bars."""


class MountViews:
    """See the module."""

    def __init__(self, site: Site, work: BackgroundWork, settings: SettingViews) -> None:
        self._site, self._work, self._settings = site, work, settings

    def routes(self) -> list[Route]:
        """Routes of this view."""
        looking, changing = self._site.looking, self._site.changing
        return [
            Route("/setup/mount", looking(self._show)),
            Route("/setup/mount/panel", looking(self._panel)),
            Route("/setup/mount/begin", changing(self._begin), methods=["POST"]),
            Route("/setup/mount/stop", changing(self._stop), methods=["POST"]),
            Route("/setup/mount/use", changing(self._use), methods=["POST"]),
        ]

    async def _show(self, request: Request) -> Response:
        return await self._site.render(request, "mount.html.j2", **self._values())

    async def _panel(self, request: Request) -> Response:
        return await self._site.render(request, "mount_panel.html.j2", **self._values())

    async def _begin(self, request: Request, form: Form) -> Response:
        if self._work.is_busy:
            return await self._site.refused(request, self._work.busy_with, 409)
        self._work.begin(KIND, "the camera", ["mount", "--running", "--json"], lambda _: None)
        return self._site.done(request, "/setup/mount")

    async def _stop(self, request: Request, form: Form) -> Response:
        self._work.cancel(KIND)
        return self._site.done(request, "/setup/mount", "Stopped.")

    async def _use(self, request: Request, form: Form) -> Response:
        found = self._found()
        if found is None:
            return await self._site.refused(request, "The mount is not found yet.", 409)
        try:
            stated = await asyncio.to_thread(self._stated_by)
            if stated is not None:
                why = f"{stated} states a mount too: take body_from_camera out of it first."
                return await self._site.refused(request, why, 409)
            wanted = {f"mount.{name}": found[name] for name in ANGLES}
            return await self._settings.keep(request, "/setup", {"mount.known": True, **wanted})
        except CompanionError as error:
            return await self._site.refused(request, str(error), 409)

    def _stated_by(self) -> Path | None:
        """Calibration file that states a mount; None where none does."""
        file = self._site.facts.configured().camera.calibration
        size = self._site.watch.size
        if not file or size is None:
            return None
        path = Path(file)
        return path if read_calibration(path, *size).body_from_camera is not None else None

    def _found(self) -> dict[str, Any] | None:
        """Result of the search, angles as they are shown and kept; None before there is one."""
        work = self._work.of(KIND)
        if work is None or work.state != "done":
            return None
        angles = {name: round(float(work.told[name]), 1) + 0.0 for name in ANGLES}  # no -0.0
        return work.told | angles

    def _values(self) -> dict[str, Any]:
        return {
            "work": self._work.of(KIND), "busy": self._work.is_busy, "found": self._found(),
            "enough_deg": ENOUGH_DEG,
        }  # fmt: skip
