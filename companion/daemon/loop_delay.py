"""Delay of the event loop: the error of stamps that are taken in it."""

from __future__ import annotations

from companion.meters import LatencyMeter
from companion.timing.clock import FlightClock
from drivers.system.ticks import tick

TICK_S = 0.05
"""A hundred measurements in the window of the percentile; each wakes the loop."""


async def measure_loop_delay(clock: FlightClock, meter: LatencyMeter) -> None:
    """Measure by how much the loop wakes up late, repeatedly; ends by cancellation."""
    while True:
        late_s = await tick(TICK_S)
        meter.add(clock.now_ns(), max(late_s, 0.0) * 1e3)
