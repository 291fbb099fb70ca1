"""Turns of flights in real time: one that wants all cores waits for the others, and they for it.

Workers of pytest-xdist, and whoever else of this user flies here, wait in the order in which they
came. A turn is kept through all tests of a module, some of which share a flight.
"""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Generator
from pathlib import Path

import pytest

FOLDER = Path(tempfile.gettempdir(), f"companion-turns-{os.getuid()}")
ALL_CORES = "all_cores"
"""Marker of a test that flies alone."""


class Turns:
    """The rule, as a plugin of pytest. For tests marked `real_time`."""

    def __init__(self) -> None:
        self._turn: int | None = None
        self._kind: int | None = None

    # outside of pytest-timeout: who waits does not hang
    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_protocol(
        self, item: pytest.Item, nextitem: pytest.Item | None
    ) -> Generator[None, object, object]:
        if item.get_closest_marker("real_time") is not None:
            is_alone = item.get_closest_marker(ALL_CORES) is not None
            self._take(fcntl.LOCK_EX if is_alone else fcntl.LOCK_SH)
        try:
            return (yield)
        finally:
            module = item.getparent(pytest.Module)
            if nextitem is None or nextitem.getparent(pytest.Module) is not module:
                self._give_back()

    def _take(self, kind: int) -> None:
        if kind == self._kind:
            return
        self._give_back()
        FOLDER.mkdir(exist_ok=True)
        with (FOLDER / "queue").open("w") as queue:  # else one that flies alone would wait for ever
            fcntl.flock(queue, fcntl.LOCK_EX)
            self._turn = os.open(FOLDER / "turn", os.O_CREAT | os.O_RDWR, 0o600)
            fcntl.flock(self._turn, kind)
        self._kind = kind

    def _give_back(self) -> None:
        if self._turn is not None:
            os.close(self._turn)
        self._turn = self._kind = None
