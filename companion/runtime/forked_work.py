"""A stage of a replay in a process of its own, which is forked from this one.

It takes the same messages in the same order, so that its results are the same; but what it does
with them holds up no thread here, as one of Python's would. What it gives comes with a later step.
Messages gather until a frame; some of them at most are on their way at a time.
"""

from __future__ import annotations

import os
import pickle
import select
import signal
import socket
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NoReturn

from companion.errors import CompanionError, StageError
from companion.messages import Frame
from companion.products.surroundings import peak_memory_mb
from companion.runtime.parcel import Parcel, allow_descriptors
from companion.runtime.stage_protocol import Finish, Finished, Progress, Remark, Taken
from companion.runtime.stage_work import Work, module_of
from companion.timing.clock import StageTimes

MOST_BYTES, MOST_PARCELS = 128 << 20, 64
"""On their way to the process."""
GATHERED = 64
"""Small messages that go together; below INLINE_BYTES of a parcel for most."""


@dataclass(frozen=True, slots=True)
class _Raised:
    """An exception of the process, pickled; None where it cannot be."""

    pickled: bytes | None
    text: str

    def error(self) -> BaseException:
        """The exception, or one with its text."""
        if self.pickled is None:
            return StageError(self.text)
        found: BaseException = pickle.loads(self.pickled)
        return found


class _Told(StageTimes):
    """Times as the process has told them."""

    def __init__(self) -> None:
        super().__init__()
        self.told: Mapping[str, Mapping[str, float]] = {}

    def summary(self) -> dict[str, dict[str, float]]:
        return {name: dict(values) for name, values in self.told.items()}


class ForkedWork(Work):
    """The stage `name`; to be made while this process has one thread, and used by one thread."""

    def __init__(self, name: str, setup: Any, nice: int) -> None:
        super().__init__()
        self.times = self._times = _Told()
        self._name = name
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._details: Mapping[str, Any] = {}
        self._tell: Callable[[Any], None] = lambda _: None
        self._gathered: list[Any] = []
        self._sent: list[int] = []
        """Sizes of parcels that it has not taken yet, the oldest first."""
        self._given: list[Any] = []
        self._has_begun = self._has_finished = False
        self._fault: BaseException | None = None
        """The exception that has ended it."""
        sys.stdout.flush()
        sys.stderr.flush()
        self._pid = os.fork()
        if self._pid == 0:
            self._socket.close()
            _be(name, setup, nice, theirs)
        theirs.close()

    def details(self) -> Mapping[str, Any]:
        """As it has last told."""
        return self._details

    def begin(self, tell: Callable[[Any], None]) -> None:
        """Wait until it has begun; what it raises is raised."""
        self._tell = tell
        while not self._has_begun and self._fault is None:
            self._receive()
        if self._fault is not None:
            raise self._fault

    def step(self, message: Any) -> Iterator[Any]:
        """Pass a message on, or let it wait for others; what has been given meanwhile."""
        self._gathered.append(message)
        if isinstance(message, Frame) or len(self._gathered) >= GATHERED:
            self._send()
        while self._fault is None and _is_ready(self._socket, select.POLLIN, wait=False):
            self._receive()
        yield from self._taken_out()

    def finish(self, finish: Finish) -> Iterator[Any]:
        """Let it finish, and wait for that; the last results."""
        self._gathered.append(finish)
        self._send()
        while not self._has_finished and self._fault is None:
            self._receive()
        if self._has_finished:
            self._end()
        yield from self._taken_out()

    def _taken_out(self) -> Iterator[Any]:
        """Messages that it has given; then raises what it raised."""
        given, self._given = self._given, []
        yield from given
        if self._fault is not None:
            raise self._fault

    def _send(self) -> None:
        parcel = Parcel.of(self._gathered)
        self._gathered = []
        while self._fault is None:
            if sum(self._sent) > MOST_BYTES or len(self._sent) >= MOST_PARCELS:
                self._receive()
                continue
            try:
                parcel.send(self._socket, socket.MSG_DONTWAIT)
            except BlockingIOError:  # it may wait for us to take what it gives
                if _is_ready(self._socket, select.POLLIN | select.POLLOUT) & select.POLLIN:
                    self._receive()
            except OSError:  # it has ended; why, it may have told
                self._receive()
            else:
                self._sent.append(parcel.n_bytes)
                return

    def _receive(self) -> None:
        """Take the next that it sends."""
        try:
            parcels = Parcel.receive(self._socket)
        except (EOFError, OSError):
            status = self._end()
            how = f"was ended by {signal.Signals(-status).name}" if status < 0 else "has ended"
            self._fault = StageError(f"the process of {self._name} {how}")
            return
        for parcel in parcels:
            message = parcel.open()
            if isinstance(message, Taken):
                self._sent.pop(0)
            elif isinstance(message, Remark):
                self._tell(message)
            elif isinstance(message, Progress):
                self._has_begun, self._details = True, message.details
                self.device = message.device
            elif isinstance(message, Finished):
                self._has_finished, self._times.told = True, message.times
            elif isinstance(message, _Raised):
                self._end()
                self._fault = message.error()
            else:
                self._given += message

    def _end(self) -> int:
        """Wait for its end; the exit status."""
        self._socket.close()
        return os.waitstatus_to_exitcode(os.waitpid(self._pid, 0)[1])


def _is_ready(of: socket.socket, events: int, wait: bool = True) -> int:
    waiting = select.poll()
    waiting.register(of, events)
    return next((found for _, found in waiting.poll(None if wait else 0)), 0)


# -- in the process -----------------------------------------------------------------------------


def _be(name: str, setup: Any, nice: int, caller: socket.socket) -> NoReturn:
    """Be the stage, until it has finished or nobody is there to work for."""
    status = 1
    try:
        for number in (signal.SIGINT, signal.SIGTERM):  # the caller says when to finish
            signal.signal(number, signal.SIG_IGN)
        Path("/proc/self/comm").write_text(name, "utf-8")
        os.nice(nice)
        allow_descriptors()
        _work(name, setup, caller)
        status = 0
    except (EOFError, BrokenPipeError):
        pass
    except BaseException as error:
        if not isinstance(error, CompanionError | OSError):
            traceback.print_exc()
        Parcel.of(_raised(error)).send(caller)
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def _work(name: str, setup: Any, caller: socket.socket) -> None:
    def send(message: Any) -> None:
        Parcel.of(message).send(caller)

    work = module_of(name).work(setup)
    work.begin(lambda told: send(told) if isinstance(told, Remark) else None)
    send(_progress(work))
    while True:
        for parcel in Parcel.receive(caller):
            messages = parcel.open()
            del parcel
            send(Taken(1))
            for message in messages:
                if isinstance(message, Finish):
                    send([*work.finish(_with_own_memory(message))])
                    send(_progress(work))
                    send(Finished(work.times.summary(), work.device))
                    return
                if given := [*work.step(message)]:
                    send(given)


def _progress(work: Work) -> Progress:
    return Progress(device=work.device, details=work.details())


def _with_own_memory(finish: Finish) -> Finish:
    """The same, with the peak memory of this process added to the caller's."""
    if finish.facts is None:
        return finish
    whole_mb = finish.facts.peak_memory_mb + peak_memory_mb()
    return replace(finish, facts=replace(finish.facts, peak_memory_mb=whole_mb))


def _raised(error: BaseException) -> _Raised:
    text = f"{type(error).__name__}: {error}"
    try:
        pickled = pickle.dumps(error)
        pickle.loads(pickled)
    except Exception:
        return _Raised(None, text)
    return _Raised(pickled, text)
