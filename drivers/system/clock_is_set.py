"""State of the computer's clock: synchronised by the network or not."""

from __future__ import annotations

import ctypes
from pathlib import Path

TIMEX_BYTES = 512
"""Larger than struct timex anywhere (adjtimex(2))."""
TIME_ERROR = 5
"""Result of adjtimex for an unsynchronised clock."""
SYNCHRONISED = Path("/run/systemd/timesync/synchronized")
"""Written by systemd-timesyncd when it has set the clock (systemd-timesyncd.service(8))."""


def clock_is_set() -> bool:
    """True if the clock is synchronised by the network; False too where unknown.

    In a service that may not set the clock the kernel does not tell (ProtectClock=).
    """
    if SYNCHRONISED.exists():
        return True
    reading = ctypes.create_string_buffer(TIMEX_BYTES)  # modes 0: only asks
    answer = int(ctypes.CDLL(None, use_errno=True).adjtimex(reading))
    return 0 <= answer < TIME_ERROR
