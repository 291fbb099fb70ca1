"""A link to an autopilot without a wire, at times that a test sets."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from companion.config import LinkConfig
from companion.messages import Warned
from companion.telemetry import Telemetry
from companion.timing.clock import FlightClock
from drivers.mavlink.autopilot_link import AutopilotLink
from tests.support.autopilot.memory_port import MemoryPort


class SetClock(FlightClock):
    """Stands still but for who sets it."""

    def __init__(self) -> None:
        super().__init__(epoch_ns=1_795_000_000 * 10**9)
        self.t_ns = self.epoch_ns + 2000 * 10**9

    def now_ns(self) -> int:
        return self.t_ns


def memory_link(
    port: MemoryPort, clock: FlightClock, deliver: Callable[[Telemetry], None],
    warn: Callable[[Warned], None] = lambda _: None,
) -> AutopilotLink:  # fmt: skip
    """A link on this port; it hears nothing before `listen`."""
    return AutopilotLink(LinkConfig(), port, clock, deliver, warn)


async def listen(link: AutopilotLink) -> None:
    """Let it hear what its port does, and do nothing by itself."""
    task = asyncio.create_task(link.run())
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
