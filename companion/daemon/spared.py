"""Parts of the daemon that the pose goes on without."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Coroutine
from typing import Any

FAILED = "a part of the daemon has failed, and is off until the next start"


async def spared(
    name: str, part: Coroutine[Any, Any, None], tell: Callable[[str, str], None]
) -> None:
    """Run a part; a fault ends that part alone, and is told: what has happened, and where."""
    try:
        await part
    except Exception:  # a bug, of whatever kind: it must not take the pose from a vehicle in flight
        tell(FAILED, f"{name}: {traceback.format_exc()}")
