"""How late the event loop is: what stamps made in it may be wrong by."""

from __future__ import annotations

import asyncio

from companion.health import LatencyMeter
from companion.timing.clock import FlightClock

TICK_S = 0.01


async def measure_loop_delay(clock: FlightClock, meter: LatencyMeter) -> None:
    """Note again and again how much later than asked the loop wakes up; ends by cancellation."""
    while True:
        asked_ns = clock.now_ns() + round(TICK_S * 1e9)
        await asyncio.sleep(TICK_S)
        now_ns = clock.now_ns()
        meter.add(now_ns, max(now_ns - asked_ns, 0) * 1e-6)
