"""What came of stages in processes of their own, in its order; waits until something has come."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from companion.runtime.parcel import Parcel
from tests.support.processes.tiny_stages import Said

SOON_S = 30.0
"""Longest wait for what comes at once, on a machine that has much else to do."""


class Heard:
    """Takes parcels and words from any thread."""

    def __init__(self) -> None:
        self.all: list[Any] = []
        self._came = threading.Condition()

    def parcel(self, parcel: Parcel) -> None:
        """Take a message of a stage."""
        self.note(parcel.open())

    def note(self, what: Any) -> None:
        """Take anything else."""
        with self._came:
            self.all.append(what)
            self._came.notify_all()

    def until(self, such: Callable[[], Any]) -> None:
        """Wait until something is so; it is looked at as often as something comes."""
        with self._came:
            assert self._came.wait_for(such, SOON_S), self.all

    def texts(self, who: str) -> list[str]:
        """What has been `Said` by a name."""
        return [each.text for each in self.all if isinstance(each, Said) and each.who == who]

    def until_said(self, who: str, text: str) -> None:
        """Wait for a `Said`."""
        self.until(lambda: text in self.texts(who))
