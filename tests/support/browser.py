"""Chromium without a window, driven by playwright; what it complains of is kept.

with Browser(width=390) as browser:
    browser.page.goto(url)
    assert not browser.complaints
"""

from __future__ import annotations

import tempfile
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any
from urllib.parse import urlsplit

from companion.page.doctor_process import LONGEST_S

CHROMIUM = Path("/usr/bin/chromium")
FLAGS = (
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
)  # fmt: skip
"""So that it asks nothing of the network by itself."""
WAIT_MS = round(1e3 * (LONGEST_S + 10.0))
"""Longest wait for what a page is to show: of all that it shows the findings of the doctor take
longest, and how long it waits for these itself it says."""


class Browser:
    """See above; `width` and `height` are those of its page, CSS pixels."""

    def __init__(self, width: int = 1280, height: int = 800) -> None:
        self._width, self._height = width, height
        self.complaints: list[str] = []
        """Errors and warnings of the console, and faults of scripts."""
        self.asked: set[str] = set()
        """Hosts that were asked for anything."""
        self._open = ExitStack()
        self.page: Any = None

    def __enter__(self) -> Browser:
        from playwright.sync_api import sync_playwright

        with ExitStack() as entering:
            driver = entering.enter_context(sync_playwright())
            home = entering.enter_context(tempfile.TemporaryDirectory())
            context = driver.chromium.launch_persistent_context(
                home, executable_path=str(CHROMIUM), args=list(FLAGS), accept_downloads=True,
                viewport={"width": self._width, "height": self._height},
            )  # fmt: skip
            entering.callback(context.close)
            self.page = context.pages[0]
            self.page.set_default_timeout(WAIT_MS)
            self.page.on("console", self._said)
            self.page.on("request", lambda request: self.asked.add(urlsplit(request.url).netloc))
            self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
            self._open = entering.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self._open.close()

    def _said(self, message: Any) -> None:
        if message.type in ("error", "warning"):
            self.complaints.append(f"{message.type}: {message.text}")
