from __future__ import annotations

import asyncio
import contextlib
import time

from companion.clock import FlightClock
from companion.health import LatencyMeter
from drivers.loop_delay import watch_loop_delay


def test_a_loop_that_is_held_up_shows() -> None:
    clock, meter = FlightClock(), LatencyMeter()

    async def test() -> None:
        watching = asyncio.create_task(watch_loop_delay(clock, meter))
        await asyncio.sleep(0.15)
        usual_ms = meter.percentile_ms(50, clock.now_ns())
        assert usual_ms is not None
        assert usual_ms < 20
        time.sleep(0.2)
        await asyncio.sleep(0.03)
        late_ms = meter.percentile_ms(99, clock.now_ns())
        assert late_ms is not None
        assert 150 < late_ms < 2000
        watching.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await watching

    asyncio.run(test())
