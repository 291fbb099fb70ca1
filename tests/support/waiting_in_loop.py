"""Waiting, in an event loop, for what another task brings about."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

from tests.support.waiting import PATIENCE_S

LOOK_EVERY_S = 0.002


async def until(
    such: Callable[[], object], timeout_s: float = PATIENCE_S, what: Callable[[], object] = str
) -> None:
    """Wait until something is so; AssertionError, with `what` is seen, where it does not come."""
    until_s = time.monotonic() + timeout_s
    while not such():
        assert time.monotonic() < until_s, f"not within {timeout_s:g} s; {what()}"
        await asyncio.sleep(LOOK_EVERY_S)
