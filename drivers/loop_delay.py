"""How late the event loop comes to what is due."""

from __future__ import annotations

import asyncio

from companion.clock import FlightClock
from companion.health import LatencyMeter

EVERY_S = 0.02


async def watch_loop_delay(clock: FlightClock, meter: LatencyMeter) -> None:
    """Measure for as long as the loop runs; ends by cancellation."""
    while True:
        due_ns = clock.now_ns() + round(EVERY_S * 1e9)
        await asyncio.sleep(EVERY_S)
        now_ns = clock.now_ns()
        meter.add(now_ns, max(now_ns - due_ns, 0) * 1e-6)
