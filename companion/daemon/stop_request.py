"""End of the daemon: asked for by a signal, or due to a failure."""

from __future__ import annotations

import asyncio

from drivers.system.journal import ERROR, Journal

FAULT, BAD_INPUT, RESTART = 1, 2, 75
"""Exit statuses; the last asks the service manager for another start (sysexits.h, EX_TEMPFAIL)."""


class StopRequest:
    """Event that ends the daemon, with its exit status. Used in the event loop."""

    def __init__(self, journal: Journal) -> None:
        self._journal = journal
        self._event = asyncio.Event()
        self.status = 0
        self.hurried = False
        """True unless a person asked once: then results are waited for."""

    @property
    def made(self) -> bool:
        """True once the daemon is to end."""
        return self._event.is_set()

    def stop(self) -> None:
        """End the daemon soon: the service manager waits for some seconds only."""
        self.hurried = True
        self._event.set()

    def interrupt(self) -> None:
        """End the daemon with all results, or soon where that was asked before: Ctrl-C."""
        self.hurried = self.made
        self._event.set()

    def fail(self, why: str, status: int = FAULT) -> None:
        """End the daemon with an error; the first one is reported."""
        if self.status == 0:
            self._journal.say(f"error: {why}", ERROR)
            self.status = status
        self.stop()

    def restart(self) -> None:
        """End the daemon soon, so that the service manager starts it again."""
        self.status = self.status or RESTART
        self.stop()

    async def wait(self) -> None:
        """Wait for the request."""
        await self._event.wait()
