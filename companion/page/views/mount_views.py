"""View Mount: the vehicle is turned by hand, and the mount found of the rotations."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import Response

from companion.page.views.site import Form, RefusedError
from companion.page.views.work_views import WorkViews
from drivers.images.calibration_file import read_calibration

ANGLES = ("roll_deg", "pitch_deg", "yaw_deg")
ENOUGH_DEG = 30.0
"""Range of each angle that the search wants, for its bars."""


class MountViews(WorkViews):
    """See the module."""

    kind = "mount"

    def _command(self, form: Form) -> tuple[str, list[str]]:
        return "the camera", ["mount", "--running", "--json"]

    async def _use(self, request: Request, form: Form) -> Response:
        found = self._found()
        if found is None:
            raise RefusedError("The mount is not found yet.")
        stated = await asyncio.to_thread(self._stated_by)
        if stated is not None:
            raise RefusedError(
                f"{stated} states a mount too: take body_from_camera out of it first."
            )
        wanted = {f"mount.{name}": found[name] for name in ANGLES}
        return await self._settings.keep(request, "/setup", {"mount.known": True, **wanted})

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
        told = self._work.result(self.kind)
        if told is None:
            return None
        return told | {name: round(float(told[name]), 1) + 0.0 for name in ANGLES}  # no -0.0

    def _values(self) -> dict[str, Any]:
        return {"found": self._found(), "enough_deg": ENOUGH_DEG}
