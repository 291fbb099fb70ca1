"""Delay of the event loop: the error of stamps that are taken in it."""

from __future__ import annotations

import asyncio

from companion.meters import LatencyMeter
from companion.timing.clock import FlightClock

TICK_S = 0.05
"""A hundred measurements in the window of the percentile; each wakes the loop."""


async def measure_loop_delay(clock: FlightClock, meter: LatencyMeter) -> None:
    """Measure by how much the loop wakes up late, repeatedly; ends by cancellation."""
    while True:
        asked_ns = clock.now_ns() + round(TICK_S * 1e9)
        await asyncio.sleep(TICK_S)
        now_ns = clock.now_ns()
        meter.add(now_ns, max(now_ns - asked_ns, 0) * 1e-6)
