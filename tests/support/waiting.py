"""Waiting for what another thread or process brings about."""

from __future__ import annotations

import time
from collections.abc import Callable

PATIENCE_S = 90.0
"""So long is waited for what a quiet machine does in seconds: how soon is asked elsewhere."""
LOOK_EVERY_S = 0.01


def until(such: Callable[[], object], what: str = "", timeout_s: float = PATIENCE_S) -> None:
    """Wait until something is so; AssertionError where it does not come about."""
    until_s = time.monotonic() + timeout_s
    while not such():
        assert time.monotonic() < until_s, f"not within {timeout_s:g} s: {what or 'as wanted'}"
        time.sleep(LOOK_EVERY_S)
