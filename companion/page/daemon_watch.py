"""State of the daemon as the page knows it: its status, asked once a second while anyone looks."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path
from typing import Any

from companion.errors import SourceError
from companion.timing.clock import monotonic_s
from drivers.system.status_socket import ask_status

FRESH_S = 0.8
KEEP_VIEWER_EVERY_S = 2.0


class DaemonWatch:
    """Asks at `socket`, for all who look, no more often than once in FRESH_S."""

    def __init__(self, socket: Path) -> None:
        self._socket = socket
        self._lock = asyncio.Lock()
        self._asked_s = -FRESH_S
        self._kept_s = -KEEP_VIEWER_EVERY_S
        self._document: dict[str, Any] = {}
        self.problem = ""
        """Reason why the daemon does not answer; "" where it does."""

    async def status(self) -> dict[str, Any]:
        """Status document; {} where the daemon does not answer."""
        async with self._lock:
            if monotonic_s() - self._asked_s > FRESH_S:
                try:
                    self._document = await asyncio.to_thread(ask_status, self._socket)
                    self.problem = ""
                except SourceError as error:
                    self._document, self.problem = {}, str(error)
                self._asked_s = monotonic_s()
            return self._document

    async def is_armed(self) -> bool:
        """True while the motors are armed, or where that is not known: asked anew."""
        self._asked_s = -FRESH_S
        return bool((await self.status()).get("armed", True))

    @property
    def viewers_port(self) -> int:
        """Port of the exporter by the newest status; 0 where unknown."""
        return int(self._document.get("viewers_port") or 0)

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height of the camera's images by the newest status; None where unknown."""
        size = self._document.get("size")
        return (int(size[0]), int(size[1])) if size else None

    def keep_viewer(self) -> None:
        """Ask the daemon, no more often than needed, to keep the viewer's pictures under load."""
        if monotonic_s() - self._kept_s > KEEP_VIEWER_EVERY_S:
            self._kept_s = monotonic_s()
            self.order("viewer")

    def order(self, word: str) -> None:
        """Ask the daemon to `reload`, to `restart`, or to keep the `viewer`."""
        sys.stdout.write(f"{word}\n")
        sys.stdout.flush()
