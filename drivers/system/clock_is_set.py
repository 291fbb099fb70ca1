"""Whether the computer's clock is the time of day, or what it happened to have when it started."""

from __future__ import annotations

import ctypes
from pathlib import Path

TIMEX_BYTES = 512
"""More than struct timex has anywhere (adjtimex(2))."""
TIME_ERROR = 5
"""What adjtimex answers for a clock that nobody keeps in step."""
SYNCHRONISED = Path("/run/systemd/timesync/synchronized")
"""Made by systemd-timesyncd when it has set the clock (systemd-timesyncd.service(8))."""


def clock_is_set() -> bool:
    """Whether the clock is kept in step with the network's; False too where nobody can tell.

    Within a service that may not touch the clock the kernel is not to be asked (ProtectClock=).
    """
    if SYNCHRONISED.exists():
        return True
    reading = ctypes.create_string_buffer(TIMEX_BYTES)  # modes 0: only asks
    answer = int(ctypes.CDLL(None, use_errno=True).adjtimex(reading))
    return 0 <= answer < TIME_ERROR
