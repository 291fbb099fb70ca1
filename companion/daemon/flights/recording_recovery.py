"""Recovery of recordings that an earlier daemon could not finish, in the background.

Runs `companion flights repair` in a process of lowest priority, and never while armed. A folder
that cannot be written is told at once: the first flight would be too late to hear of it.
"""

from __future__ import annotations

import asyncio
import contextlib
import sys
import tempfile
from asyncio.subprocess import DEVNULL, PIPE, Process
from collections.abc import Callable
from pathlib import Path

from companion.messages import Warned
from companion.timing.clock import FlightClock
from drivers.system.low_priority import give_way

AFTER_S = 10.0
"""Delay after the start, or the end of a flight, when other work has priority."""
LOOK_S = 0.2
CUT_SHORT = "an earlier recording was cut short"
NOT_WRITABLE = "the folder of flights cannot be written"
NOT_REPAIRED = "recordings that were cut short cannot be looked for now"


class RecordingRecovery:
    """Repairs recordings in a process. Used in the event loop; `warn` takes a warning for each."""

    def __init__(
        self, flights: Path, clock: FlightClock, warn: Callable[[Warned], None],
        armed: Callable[[], bool],
    ) -> None:  # fmt: skip
        self._flights, self._clock, self._warn, self._armed = flights, clock, warn, armed

    async def run(self) -> None:
        """Repair recordings, now and after each flight, until cancelled."""
        loop = asyncio.get_running_loop()
        why_not = await loop.run_in_executor(None, _why_not_writable, self._flights)
        if why_not is not None:
            self._warn(Warned(self._clock.now_ns(), NOT_WRITABLE, why_not))
        while True:
            await asyncio.sleep(AFTER_S)
            if not self._armed() and await self._repaired():
                while not self._armed():
                    await asyncio.sleep(LOOK_S)

    async def _repaired(self) -> bool:
        """Run one repair; False where arming has cut it short, or it could not begin."""
        try:
            process = await asyncio.create_subprocess_exec(
                sys.executable, "-m", "companion", "flights", "repair", "--gently",
                "--flights", str(self._flights), stdin=DEVNULL, stdout=PIPE, stderr=DEVNULL,
            )  # fmt: skip
        except OSError as error:  # no memory, process or descriptor for it: later there may be
            self._warn(Warned(self._clock.now_ns(), NOT_REPAIRED, error.strerror or str(error)))
            return False
        give_way(process.pid)
        reading = asyncio.ensure_future(self._read(process))
        try:
            while not reading.done() and not self._armed():
                await asyncio.wait([reading], timeout=LOOK_S)
            if reading.done():
                reading.result()
            return reading.done()
        finally:  # what is half repaired can be repaired again
            reading.cancel()
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()

    async def _read(self, process: Process) -> None:
        assert process.stdout is not None
        async for line in process.stdout:
            text = line.decode("utf-8", "replace").strip()
            self._warn(Warned(self._clock.now_ns(), CUT_SHORT, text))
        await process.wait()  # to kill what ends by itself would take its status from the loop


def _why_not_writable(folder: Path) -> str | None:
    """The reason why nothing can be written to a folder, which is made; None where it can."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return None
    except OSError as error:
        return f"{folder}: {error.strerror or error}; daemon.flights names the folder"
