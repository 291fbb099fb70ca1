"""Checks of the daemon's event loop, and what they cost it."""

from __future__ import annotations

import asyncio
import threading
from types import SimpleNamespace
from typing import Any

from companion.config import Config
from companion.daemon.periodic_checks import PeriodicChecks
from drivers.system.journal import WARNING
from drivers.system.service_manager import ServiceManager

SOON_S = 30.0


class HangingDates:
    """Dates that are always due, on a disk that hangs until `goes_on`."""

    def __init__(self) -> None:
        self.goes_on = threading.Event()
        self.n_begun = 0

    def step(self) -> bool:
        return True

    def write(self) -> None:
        self.n_begun += 1
        assert self.goes_on.wait(SOON_S)


def checks_with(**parts: Any) -> PeriodicChecks:
    """Checks of which only the given parts are there."""
    names = (
        "settings", "clock", "journal", "service", "feed", "link", "link_watch", "flights",
        "dates", "watch", "starts", "proof", "stop",
    )  # fmt: skip
    there: dict[str, Any] = dict.fromkeys(names)
    return PeriodicChecks(**there | {"settings": SimpleNamespace(config=Config()), **parts})


def test_a_service_manager_that_is_not_told_is_named_once() -> None:
    said: list[tuple[str, int]] = []
    watch: Any = SimpleNamespace(line_due=lambda health: None)
    journal: Any = SimpleNamespace(say=lambda text, priority: said.append((text, priority)))
    service = ServiceManager({"NOTIFY_SOCKET": "vsock:2:1234"})
    health: Any = None

    async def scene() -> None:
        checks = checks_with(watch=watch, journal=journal, service=service)
        for _ in range(3):
            checks._report(health)

    asyncio.run(scene())
    assert said == [(f"warning: {service.problem}", WARNING)] and "vsock" in service.problem


async def test_a_disk_that_hangs_holds_one_thread() -> None:
    dates = HangingDates()
    checks = checks_with(dates=dates)
    for _ in range(5):
        checks._step_dates()
    dates.goes_on.set()
    assert checks._dating is not None
    await checks._dating
    assert dates.n_begun == 1
    checks._step_dates()
    await checks._dating
    assert dates.n_begun == 2
