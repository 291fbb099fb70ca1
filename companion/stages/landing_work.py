"""Stage `landing`: the marker to land on, in every newest frame."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from companion.estimation.landing.marker_detector import MarkerDetector
from companion.messages import Frame, Message
from companion.runtime.stage_protocol import Finish, Setup
from companion.runtime.stage_work import Work
from drivers.system.file_pages import give_back_library_pages


class _Landing(Work):
    def __init__(self, setup: Setup) -> None:
        super().__init__()
        self._detector = MarkerDetector(setup.config.landing, setup.camera)
        if setup.is_live:  # in a process of its own
            give_back_library_pages()

    def step(self, message: Any) -> Iterable[Message]:
        if not isinstance(message, Frame):
            return []
        with self.times("landing marker"):
            return [self._detector.step(message)]

    def finish(self, finish: Finish) -> Iterable[Message]:
        return []


work = _Landing
"""The stage for a setup."""
