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

    async def examine(self, *set_names: str) -> dict[str, Any]:
        """Examine, and set these parameters first; what was found."""
        async with self._lock:
            arguments = ["doctor", "--json"]
            if set_names:
                arguments += ["--write", "--yes"]
                for name in set_names:
                    arguments += ["--only", name]
            self.found = await _document([*arguments, *self._facts.arguments()])
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
