"""Timeouts that never swallow a cancellation."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable
from typing import TypeVar

T = TypeVar("T")


async def within(awaitable: Awaitable[T], timeout_s: float) -> T:
    """Result of an awaitable; asyncio.TimeoutError if it takes longer, and it is cancelled then.

    Up to Python 3.11 asyncio.wait_for loses a cancellation that comes together with the result.
    """
    task = asyncio.ensure_future(awaitable)
    try:
        await asyncio.wait({task}, timeout=timeout_s)
        if not task.done():
            raise asyncio.TimeoutError
        return task.result()
    finally:
        task.cancel()
