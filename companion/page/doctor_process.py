"""`companion doctor` run for the page, in a process of its own, one at a time."""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
from collections.abc import Sequence
from typing import Any

from companion.page.facts import Facts
from drivers.system.low_priority import take_turn

LONGEST_S = 90.0
LEVELS = 10
"""It stands so much nearer to a stage than the page: somebody waits for it, before take-off. At the
page's own level half a second of computing takes a minute where the processors are full."""
MOST_BYTES = 1 << 20


class Doctor:
    """Runs it, and keeps what it found last."""

    def __init__(self, facts: Facts) -> None:
        self._facts = facts
        self._lock = asyncio.Lock()
        self.found: dict[str, Any] | None = None
        """Its JSON document, or {"error": …}; None before it was asked."""

    @property
    def is_busy(self) -> bool:
        """True while it examines."""
        return self._lock.locked()

    async def examine(self) -> dict[str, Any]:
        """Examine; what was found."""
        return await self._ask()

    async def set_one(self, name: str) -> dict[str, Any]:
        """Set this parameter to what is wanted; what was found after it."""
        return await self._ask("--write", "--yes", "--only", name)

    async def set_all(self) -> dict[str, Any]:
        """Set all that can be set; what was found after it.

        These can be more than were found before: a value that is set can ask for another one, and
        the measured latency changes.
        """
        return await self._ask("--write", "--yes")

    async def _ask(self, *options: str) -> dict[str, Any]:
        async with self._lock:
            self.found = await _document(["doctor", "--json", *options, *self._facts.arguments()])
            return self.found


async def _document(arguments: Sequence[str]) -> dict[str, Any]:
    """JSON that a command prints, {"error": …} where it prints none."""
    child = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "companion", *arguments, limit=MOST_BYTES,
        stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )  # fmt: skip
    take_turn(child.pid, LEVELS)
    try:
        out, said = await asyncio.wait_for(child.communicate(), LONGEST_S)
    except asyncio.TimeoutError:
        return {"error": f"no answer within {LONGEST_S:.0f} s"}
    finally:
        with contextlib.suppress(ProcessLookupError):
            child.kill()
        await child.wait()
    try:
        found = json.loads(out)
        if isinstance(found, dict):
            return found
    except ValueError:
        pass
    lines = said.decode(errors="replace").strip().splitlines()
    error = lines[-1] if lines else "it has ended without a word"
    return {"error": error.removeprefix("companion: error: ")}
