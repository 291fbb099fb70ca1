"""View Lens: the board on this screen or printed, live coverage, the verdict, the calibration."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import Response

from companion.page.views.site import Form, RefusedError
from companion.page.views.work_views import WorkViews

BOARD = "charuco:7x5:0.04:0.03:DICT_5X5_100"
"""The board of static/board.svg; for the lens the size at which it is shown does not matter."""
FOLDER = "calibrations"
"""Folder beside the file of settings."""
NO_FILE = "companion was started without --config FILE: no calibration can be kept"


class LensViews(WorkViews):
    """See the module."""

    kind = "lens"
    stopped = "Stopped: nothing was written."

    def _command(self, form: Form) -> tuple[str, list[str]]:
        folder = self._folder()
        if folder is None:
            raise RefusedError(NO_FILE)
        board = form.get("board", "").strip() or BOARD
        names = (f"lens-{number}" for number in itertools.count(1))
        name = next(each for each in names if not (folder / f"{each}.toml").exists())
        arguments = ["calibrate", "--running", "--json", "--name", name, "--out", str(folder)]
        return board, [*arguments, f"--board={board}"]

    async def _use(self, request: Request, form: Form) -> Response:
        file = self._calibration()
        if file is None:
            raise RefusedError("There is no calibration yet.")
        return await self._settings.keep(request, "/setup", {"camera.calibration": file})

    def _folder(self) -> Path | None:
        path = self._site.facts.path
        return None if path is None else path.parent / FOLDER

    def _calibration(self) -> str | None:
        """File that was written; None where none was."""
        found = (self._work.result(self.kind) or {}).get("calibration")
        return str(found) if found else None

    def _values(self) -> dict[str, Any]:
        return {
            "board": BOARD, "can_keep": self._folder(), "calibration": self._calibration()
        }  # fmt: skip
