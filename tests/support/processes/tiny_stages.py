"""Stages that do what they are told to, and nothing else: for tests of how stages are run.

`tiny_stage_child` is the process that runs one of them. What a test tells a stage is a `Do`, and
what that answers a `Said`; a frame is answered with its number.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from companion.errors import CompanionError, DeviceError, InputError
from companion.messages import Frame, MapUpdate
from companion.runtime.stage_protocol import DriverAtWork, Finish, Remark, SetLoadLevel, Setup
from companion.runtime.stage_work import Work
from companion.runtime.stages import Death, Frames, Stage
from companion.telemetry import ArmedSample, LandedSample

UNUSABLE = "unusable"
"""Name of a folder of which no stage can make anything."""
GIVEN_UP = "no room on the disk"
ERRORS = {
    "device": DeviceError("it is gone", "by what its driver says"),
    "disk": OSError(28, "no room"),
    "bug": KeyError("no such key"),
    "not pickled": type("Local", (Exception,), {})("of no module"),
}


@dataclass(frozen=True, slots=True)
class Do:
    """What a stage is to do: `say`, `say much`, `say how it began`, `remark`, `hang`, `exit`,
    `crash`, `give up`, `raise` one of `ERRORS`, `drive`, or at its end `be slow to finish`, `fail
    to finish`."""

    t_ns: int
    what: str
    detail: str = ""


@dataclass(frozen=True, slots=True)
class Said:
    """Words of a stage."""

    t_ns: int
    who: str
    text: str


SOURCE = Stage(
    "source", (Frame, Do), nice=1, frames=Frames.NEWEST, death=Death.ENDS_FLIGHT, is_source=True,
)  # fmt: skip
READER = Stage("reader", (Frame, Do, MapUpdate), nice=1, frames=Frames.EVERY)
WRITER = Stage("writer", (Said, MapUpdate), nice=1, with_flight=True, in_folder=True)
STAGES = SOURCE, READER, WRITER
"""Of a flight;"""
LEFT_OVER = Stage("left over", (Do,), nice=20)
"""and one more."""


class TinyWork(Work):
    """See above."""

    def __init__(self, setup: Setup) -> None:
        super().__init__()
        if setup.folder is not None and setup.folder.name == UNUSABLE:
            raise InputError(f"{setup.folder}: cannot be used")
        self._tell: Callable[[Any], None] = print
        self._at_the_end = self._began_as = ""

    def begin(self, tell: Callable[[Any], None]) -> None:
        self._tell = tell
        self._began_as = f"policy {os.sched_getscheduler(0)}, nice {os.nice(0)}"
        threading.Thread(target=threading.Event().wait, name="driver", daemon=True).start()

    def step(self, message: Any) -> Iterator[Any]:
        if isinstance(message, Do):
            yield from self._do(message)
        elif isinstance(message, Frame):
            yield Said(message.t_ns, "frame", str(message.seq))
        elif isinstance(message, ArmedSample | LandedSample):
            yield Said(message.t_ns, "sample", str(message.t_ns))
        elif isinstance(message, SetLoadLevel):
            yield Said(0, "load", str(message.level))
        elif isinstance(message, MapUpdate):
            yield Said(message.t_ns, "map", str(message.revision))
        elif message.who != "heard":  # by itself
            yield Said(message.t_ns, "heard", f"{message.who} {message.text}")

    def _do(self, what: Do) -> Iterator[Any]:
        if what.what == "say":
            yield Said(what.t_ns, "told", what.detail)
        elif what.what == "say much":
            yield from [Said(what.t_ns, "told", what.detail * 20_000)] * 30
        elif what.what == "say how it began":
            yield Said(what.t_ns, "began", self._began_as)
        elif what.what == "remark":
            self._tell(Remark(what.detail))
        elif what.what == "raise":
            raise ERRORS[what.detail]
        elif what.what == "hang":
            threading.Event().wait()
        elif what.what == "exit":
            os._exit(int(what.detail))
        elif what.what == "crash":
            os.kill(os.getpid(), signal.SIGSEGV)
        elif what.what == "give up":
            raise CompanionError(GIVEN_UP)
        elif what.what == "drive":
            self._tell(DriverAtWork(what.detail, f"the {what.detail}"))
        else:
            self._at_the_end = what.what

    def finish(self, finish: Finish) -> Iterator[Any]:
        if self._at_the_end == "be slow to finish":
            threading.Event().wait()
        if self._at_the_end == "fail to finish":
            raise CompanionError(GIVEN_UP)
        yield Said(0, "last words", "in a hurry" if finish.hurry else "at leisure")


work = TinyWork
