"""Heavy work that the page starts: one at a time, in a process of low priority.

It is ended as soon as the motors are armed, or nobody knows whether they are.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
from collections import deque
from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from companion.errors import InputError
from companion.page.daemon_watch import DaemonWatch
from companion.page.facts import Facts
from drivers.system.low_priority import processor_time_s

LOWEST = "companion.page.lowest_process"
LONGEST_LINE = 1 << 16
LOOK_EVERY_S = 1.0
END_S = 5.0
"""Time to end by itself once it is cancelled."""
SAID_LINES = 20
State = Literal["running", "done", "failed", "cancelled"]
NAMES = {"lens": "A calibration", "mount": "A search of the mount", "replay": "A replay"}
ARMED = "the motors were armed"


@dataclass(slots=True)
class Work:
    """One piece of work: a command of companion that prints JSON, a line each."""

    kind: str
    """A key of NAMES."""
    about: str
    """Its subject: a flight, a camera."""
    state: State = "running"
    told: dict[str, Any] = field(default_factory=dict)
    """All that its lines have told, newer values over older ones."""
    why: str = ""
    """Reason why it failed."""
    ran_s: float = 0.0
    """Time since it began,"""
    processor_s: float = 0.0
    """and processor time that it had of it."""


class BackgroundWork:
    """Runs a work; `work` is the one that runs, or ran last, None before the first."""

    def __init__(self, facts: Facts, watch: DaemonWatch) -> None:
        self._facts, self._watch = facts, watch
        self._task: asyncio.Task[None] | None = None
        self._child: asyncio.subprocess.Process | None = None
        self.work: Work | None = None

    @property
    def is_busy(self) -> bool:
        """True while a work runs."""
        return self._task is not None and not self._task.done()

    def of(self, kind: str) -> Work | None:
        """The work, if it is of this kind."""
        return self.work if self.work is not None and self.work.kind == kind else None

    def result(self, kind: str) -> dict[str, Any] | None:
        """Lines of the work, if it is of this kind and done."""
        work = self.of(kind)
        return work.told if work is not None and work.state == "done" else None

    def begin(
        self, kind: str, about: str, arguments: Sequence[str], after: Callable[[Work], None]
    ) -> None:
        """Begin a command of companion with these arguments; InputError while another runs.

        Configuration and socket are those of the daemon. `after` is called at its end.
        """
        if self.is_busy and self.work is not None:
            raise InputError(f"{NAMES[self.work.kind]} runs: stop it, or wait for it.")
        self.work = Work(kind, about)
        self._task = asyncio.create_task(self._run(self.work, arguments, after))

    def cancel(self, kind: str) -> None:
        """End the work, if one of this kind runs."""
        if self.is_busy and self.work is not None and self.work.kind == kind:
            self.work.state = "cancelled"
            self._end()

    async def _run(
        self, work: Work, arguments: Sequence[str], after: Callable[[Work], None]
    ) -> None:
        watching = asyncio.create_task(self._watch_over(work))
        try:
            command, *rest = arguments
            await self._command(work, [command, *self._facts.arguments(), *rest])
        except OSError as error:  # no process for it now
            work.state, work.why = "failed", error.strerror or str(error)
        finally:
            watching.cancel()
            await asyncio.to_thread(after, work)

    async def _command(self, work: Work, arguments: Sequence[str]) -> None:
        child = await asyncio.create_subprocess_exec(
            sys.executable, "-m", LOWEST, *arguments, limit=LONGEST_LINE,
            stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )  # fmt: skip
        self._child = child
        assert child.stdout is not None and child.stderr is not None
        said: deque[str] = deque(maxlen=SAID_LINES)
        try:
            if work.state != "running":  # cancelled meanwhile
                self._end()
            await asyncio.gather(_told(child.stdout, work), _kept(child.stderr, said))
            status = await child.wait()
        finally:
            with contextlib.suppress(ProcessLookupError):
                child.kill()
            await child.wait()
            self._child = None
        if work.state == "running":
            work.state = "done" if status == 0 else "failed"
            if status:
                line = said[-1] if said else f"it ended with status {status}"
                work.why = line.removeprefix("companion: error: ")

    def _end(self) -> None:
        child = self._child
        if child is None:
            return
        with contextlib.suppress(ProcessLookupError):
            child.terminate()

        def kill() -> None:
            with contextlib.suppress(ProcessLookupError):
                child.kill()

        asyncio.get_running_loop().call_later(END_S, kill)

    async def _watch_over(self, work: Work) -> None:
        """Note its processor time, and end it once the motors are armed."""
        loop = asyncio.get_running_loop()
        began_s = loop.time()
        while True:
            await asyncio.sleep(LOOK_EVERY_S)
            work.ran_s = loop.time() - began_s
            if self._child is not None:
                work.processor_s = max(work.processor_s, processor_time_s(self._child.pid))
            if work.state == "running" and await self._watch.is_armed():
                work.state, work.why = "failed", ARMED
                if self._child is not None:
                    with contextlib.suppress(ProcessLookupError):
                        self._child.kill()


async def _lines(stream: asyncio.StreamReader) -> AsyncIterator[bytes]:
    """Lines of a process, but for those that are longer than any of ours."""
    while True:
        with contextlib.suppress(ValueError):
            line = await stream.readline()
            if not line:
                return
            yield line


async def _told(stream: asyncio.StreamReader, work: Work) -> None:
    """Take the lines of JSON; others are passed over."""
    async for line in _lines(stream):
        with contextlib.suppress(ValueError):
            found = json.loads(line)
            if isinstance(found, dict):
                work.told |= found


async def _kept(stream: asyncio.StreamReader, said: deque[str]) -> None:
    """Keep the last lines."""
    async for line in _lines(stream):
        text = line.decode(errors="replace").strip()
        if text:
            said.append(text)
