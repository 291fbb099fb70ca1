"""Process of the page for browsers: started, started again, and heard.

The page can ask for three things, each a line on its standard output: that the configuration be
read again, that the daemon be started anew, and that the viewer be kept under load, since a step of
the setup needs its pictures. None is done while armed. It ends with its standard input, and so with
the daemon, however that ends.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from companion.config import Config
from companion.config_file import to_toml
from companion.daemon.stop_request import StopRequest
from drivers.system.journal import INFO, WARNING, Journal

PAGE = "companion.page.page_process"
RELOAD, RESTART, VIEWER = b"reload\n", b"restart\n", b"viewer\n"
"""Lines that the page may write."""
GIVE_WAY, TAKE_BACK = b"give way\n", b"take back\n"
"""Lines that it is told: while the motors are armed it gets what processor time is left over."""
ARMED_EVERY_S = 1.0
FIRST_PAUSE_S, LONGEST_PAUSE_S = 2.0, 60.0
"""Pause before it is started again; doubled while it ends soon."""
SOON_S = 30.0
LONGEST_LINE = 64


@dataclass(frozen=True, slots=True)
class SettingsSource:
    """Origin of the configuration of `companion run`: a file, and what goes over it."""

    path: Path | None = None
    overrides: tuple[str, ...] = ()


class PageChild:
    """Keeps the page of `page.listen` there. Used in the event loop.

    `armed` tells whether the motors are; `reload` has the configuration read again, `keep_viewer`
    the viewer kept for some seconds.
    """

    def __init__(
        self, config: Config, source: SettingsSource, socket: Path, supervised: bool,
        journal: Journal, armed: Callable[[], bool], reload: Callable[[], None],
        keep_viewer: Callable[[], None], stop: StopRequest,
    ) -> None:  # fmt: skip
        facts = {
            "config": to_toml(config),
            "path": str(source.path.resolve()) if source.path is not None else None,
            "overrides": list(source.overrides),
            "socket": str(socket.resolve()),
            "supervised": supervised,
        }
        self._facts = json.dumps(facts).encode() + b"\n"
        self._journal, self._armed, self._reload, self._stop = journal, armed, reload, stop
        self._keep_viewer = keep_viewer

    async def run(self) -> None:
        """Start it, and again when it has ended; ends by cancellation, and the page with it."""
        loop, pause_s = asyncio.get_running_loop(), FIRST_PAUSE_S
        while True:
            began_s = loop.time()
            try:
                why = await self._serve()
            except OSError as error:  # no process for it now
                why = error.strerror or str(error)
            pause_s = FIRST_PAUSE_S if loop.time() - began_s > SOON_S else 2 * pause_s
            pause_s = min(pause_s, LONGEST_PAUSE_S)
            self._journal.say(
                f"the page has ended ({why}) and is started again in {pause_s:.0f} s", WARNING
            )
            await asyncio.sleep(pause_s)

    async def _serve(self) -> str:
        """Run it once; the reason for its end."""
        child = await asyncio.create_subprocess_exec(
            sys.executable, "-m", PAGE, limit=LONGEST_LINE,
            stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
        )  # fmt: skip
        assert child.stdin is not None and child.stdout is not None
        child.stdin.write(self._facts)
        telling = asyncio.create_task(self._tell_armed(child.stdin))
        try:
            while line := await child.stdout.readline():
                self._take(line)
            return f"status {await child.wait()}"
        except ValueError:  # a line longer than any that it may write
            return "it wrote what it never writes"
        finally:
            telling.cancel()
            with contextlib.suppress(ProcessLookupError):
                child.kill()
            await child.wait()

    async def _tell_armed(self, stdin: asyncio.StreamWriter) -> None:
        """Tell it when the motors are armed, and when no longer."""
        told = False
        with contextlib.suppress(ConnectionError):  # it has ended, which is seen at its output
            while True:
                if self._armed() is not told:
                    told = not told
                    stdin.write(GIVE_WAY if told else TAKE_BACK)
                await stdin.drain()
                await asyncio.sleep(ARMED_EVERY_S)

    def _take(self, line: bytes) -> None:
        if line == VIEWER:
            if not self._armed():
                self._keep_viewer()
        elif line not in (RELOAD, RESTART):
            return
        elif self._armed():
            self._journal.say(f"page: no {line.decode().strip()}: the motors are armed", WARNING)
        elif line == RELOAD:
            self._reload()
        else:
            self._journal.say("page: the daemon ends, to be started again", INFO)
            self._stop.restart()
