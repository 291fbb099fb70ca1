"""Periodic work of the event loop, whose wake-ups coincide."""

from __future__ import annotations

import asyncio
import math

EARLY = 0.01
"""Part of a period by which the loop may wake up early: its timers are of one millisecond."""


async def tick(period_s: float) -> float:
    """Sleep until the next multiple of `period_s` by the loop's clock; seconds woken up late.

    Work of one period, or of multiples, wakes the loop once instead of each for itself.
    """
    loop = asyncio.get_running_loop()
    now_s = loop.time()
    due_s = period_s * (math.floor(now_s / period_s + EARLY) + 1)
    await asyncio.sleep(due_s - now_s)
    return loop.time() - due_s
