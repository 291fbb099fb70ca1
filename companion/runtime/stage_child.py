"""The process of a stage: python -m companion.runtime.stage_child NAME SOCKET_FD."""

from __future__ import annotations

import gc
import os
import resource
import socket
import sys

from companion.runtime.stage_start import ignore_signals

if __name__ == "__main__":
    ignore_signals()  # from the begin on, not after a second of imports

# before numpy loads, as in companion.__main__
for variable in (
    "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM",
):  # fmt: skip
    os.environ.setdefault(variable, "1")
# OpenCV would load an OpenCL driver with its compiler, 40 MB, for what it then does not do
os.environ.setdefault("OPENCV_OPENCL_RUNTIME", "disabled")

import contextlib  # noqa: E402
import threading  # noqa: E402
import traceback  # noqa: E402
from collections.abc import Callable  # noqa: E402
from dataclasses import replace  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

from companion.messages import Frame  # noqa: E402
from companion.runtime.collection_pause import garbage_collection_paused  # noqa: E402
from companion.runtime.gathered_samples import Samples  # noqa: E402
from companion.runtime.mailbox import Mailbox  # noqa: E402
from companion.runtime.parcel import INLINE_BYTES, Parcel  # noqa: E402
from companion.runtime.peak_memory import peak_memory_mb  # noqa: E402
from companion.runtime.stage_protocol import (  # noqa: E402
    Failed,
    Finish,
    Finished,
    Progress,
    Setup,
    Taken,
)
from companion.runtime.stage_work import Work, WorkModule, module_of  # noqa: E402
from companion.runtime.stages import (  # noqa: E402
    NICE_WITHOUT_LOSS,
    UNREAD_BYTES,
    Stage,
    drop_policy,
    lossless,
    stage_named,
)
from companion.timing.clock import monotonic_s, wait_s  # noqa: E402

IN_BYTES = 64 << 20
"""Queue in a stage's process: fifty frames of 640x480."""
TOLD_BYTES = UNREAD_BYTES // 2
"""Shared memory taken since the daemon was told: each telling wakes a thread there, and the other
half is room for three frames of 640x480."""
REPORT_EVERY_S = 1.0
LOWEST_NICE = 19
"""Lowest priority of all: runs only where nothing else wants the processor."""
SWITCH_S = 5e-4
"""Switch interval of the interpreter, so that background threads yield to the tracker."""


def main() -> int:
    """Run the stage of the command line; the exit status."""
    return run(sys.argv[1], int(sys.argv[2]))


def run(name: str, descriptor: int, ready: Callable[[], None] = lambda: None) -> int:
    """Run one stage until told to finish, or until the daemon is gone; the exit status.

    `ready` is called once it takes messages.
    """
    Path("/proc/self/comm").write_text(name, "utf-8")  # its name in top and ps
    stage = stage_named(name)
    os.nice(min(stage.nice, NICE_WITHOUT_LOSS))
    if stage.nice == 0:
        _take_real_time()
    sys.setswitchinterval(SWITCH_S)
    daemon = socket.socket(fileno=descriptor)
    module = imported(stage.name)  # which takes a second, and may be long before there is a flight
    try:
        (first,) = Parcel.receive(daemon)  # it comes by itself
        setup: Setup = first.open()
    except EOFError:
        return 0
    send = _sender(daemon)
    if not setup.is_live:
        stage = lossless(stage)
    try:
        _serve(daemon, send, stage, module, setup, ready)
    except BaseException as error:
        failed = Failed.by(error)
        if not failed.is_foreseen:
            traceback.print_exc()
        send(failed)
        return 1
    return 0


def imported(name: str) -> WorkModule:
    """Module of a stage, with all that it needs."""
    with garbage_collection_paused():
        module = module_of(name)
    gc.enable()  # which the fork server has not
    return module


def _serve(
    daemon: socket.socket, send: Callable[[Any], None], stage: Stage, module: WorkModule,
    setup: Setup, ready: Callable[[], None],
) -> None:  # fmt: skip
    work = module.work(setup)
    work.begin(send)
    if setup.is_live:
        # not before: a start that gets only what is left would take minutes where nothing is
        _stand_back(stage)
    loop = _Loop(stage, work, waits=not setup.is_live)
    send(loop.progress())
    ready()
    threading.Thread(target=loop.read, args=(daemon, send), daemon=True).start()
    threading.Thread(target=loop.report, args=(send,), name="reports", daemon=True).start()
    loop.run(send)
    send(loop.progress())
    send(Finished())


class _Loop:
    """Processes one message after the other, and reports progress, also of a step that hangs."""

    def __init__(self, stage: Stage, work: Work, waits: bool) -> None:
        self._work = work
        self._inbox: Mailbox[Parcel] = Mailbox(
            lambda parcel: drop_policy(stage, parcel.kind, in_daemon=False),
            lambda parcel: parcel.n_bytes, IN_BYTES, waits,
        )  # fmt: skip
        self._n_done = 0
        self._busy_since_s: float | None = None

    def read(self, daemon: socket.socket, send: Callable[[Any], None]) -> None:
        """Put what comes into the inbox, until the daemon is gone."""
        n_taken = n_told = 0
        try:
            while True:
                parcels = Parcel.receive(daemon)
                if parcels[0].is_shared:  # which comes alone
                    n_taken += parcels[0].n_bytes
                    if n_taken - n_told >= TOLD_BYTES:
                        n_told = n_taken
                        send(Taken(n_taken))
                self._inbox.put_all(parcels)
        except (OSError, EOFError):
            if not self._work.outlives_daemon:
                os._exit(0)  # the daemon is gone, and nobody waits for results
            self._inbox.put(Parcel.of(Finish(hurry=True)))
        except BaseException:  # it would live on and hear nothing, not even that it is to end
            sys.excepthook(*sys.exc_info())
            sys.stderr.flush()
            os._exit(1)

    def progress(self) -> Progress:
        """Progress now."""
        inbox, own = self._inbox, self._work.progress
        return replace(
            own, n_done=self._n_done, busy_since_s=self._busy_since_s, waiting_bytes=inbox.n_bytes,
            n_dropped=inbox.n_dropped + inbox.n_overflowed + own.n_dropped,
            peak_memory_mb=peak_memory_mb(),
        )  # fmt: skip

    def report(self, send: Callable[[Any], None]) -> None:
        """Report progress periodically, as long as the process lives."""
        while True:
            wait_s(threading.Event(), REPORT_EVERY_S)
            send(self.progress())

    def run(self, send: Callable[[Any], None]) -> None:
        """Work until told to finish."""
        work = self._work
        parcels: list[Parcel] = []
        while True:
            if not parcels:
                self._busy_since_s = None
                parcels = self._inbox.collect(INLINE_BYTES, 0.0)
            self._busy_since_s = monotonic_s()
            message = parcels.pop(0).open()
            if isinstance(message, Finish):
                for out in work.finish(message):
                    send(out)
                work.save(message)
                return
            for each in message.parts if isinstance(message, Samples) else (message,):
                for given in work.step(each):
                    send(given)
            self._n_done += isinstance(message, Frame)


def _stand_back(stage: Stage) -> None:
    """Take the lowest priorities, which a flight's path needs, but nobody who waits for all.

    The kernel keeps them by thread, and drivers have theirs by now.
    """
    nicer = min(stage.nice, LOWEST_NICE) - NICE_WITHOUT_LOSS
    if nicer <= 0:
        return
    for thread in map(int, os.listdir("/proc/self/task")):
        with contextlib.suppress(ProcessLookupError):  # it has ended meanwhile
            os.setpriority(os.PRIO_PROCESS, thread, os.getpriority(os.PRIO_PROCESS, thread) + nicer)
            if stage.nice > LOWEST_NICE:
                os.sched_setscheduler(thread, os.SCHED_IDLE, os.sched_param(0))


def _take_real_time() -> None:
    """Real-time priority for the pose, if the service's LimitRTPRIO and a spare core allow it.

    Only for the thread from frame to pose: threads started by it get the usual policy again.
    """
    if resource.getrlimit(resource.RLIMIT_RTPRIO)[0] == 0 or len(os.sched_getaffinity(0)) < 2:
        return
    try:
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(1))
    except OSError as error:  # some kernels let no group of processes have it
        print(f"companion: no real-time policy for the pose: {error.strerror}", file=sys.stderr)


def _sender(daemon: socket.socket) -> Callable[[Any], None]:
    lock = threading.Lock()

    def send(message: Any) -> None:
        parcel = Parcel.of(message)
        try:
            with lock:
                parcel.send(daemon)
        except OSError:
            pass  # the daemon is gone, which the reader sees

    return send


if __name__ == "__main__":
    status = main()
    sys.stderr.flush()
    os._exit(status)  # no library has a say in whether this ends
