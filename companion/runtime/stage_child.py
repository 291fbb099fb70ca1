"""The process of a stage: python -m companion.runtime.stage_child KIND NICE SOCKET_FD RING_FD."""

from __future__ import annotations

import os
import pickle
import resource
import signal
import sys

# The daemon says when to end: not Ctrl-C, which is for its own group of processes, nor systemd. No
# session of its own, though: the scheduler would share the processor between sessions first, and
# priorities would not count between stages (sched(7), autogroup).
os.setpgid(0, 0)
for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, signal.SIG_IGN)

# before numpy loads, as in companion.__main__
for variable in (
    "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM",
):  # fmt: skip
    os.environ.setdefault(variable, "1")

import threading  # noqa: E402
from collections.abc import Callable  # noqa: E402
from multiprocessing.connection import Connection  # noqa: E402
from typing import Any  # noqa: E402

from companion.errors import CompanionError, InputError  # noqa: E402
from companion.messages import Frame  # noqa: E402
from companion.runtime.frame_ring import FrameHandle, FrameRing  # noqa: E402
from companion.runtime.mail_policy import FRAMES_SHARE, IN_BYTES, drop_policy_of  # noqa: E402
from companion.runtime.mailbox import Mailbox  # noqa: E402
from companion.runtime.message_size import size_bytes  # noqa: E402
from companion.runtime.stage_protocol import Failed, Finish, Finished, Progress, Setup  # noqa: E402
from companion.runtime.stage_work import Work, WorkModule, module_of  # noqa: E402
from companion.timing.clock import monotonic_s, wait_s  # noqa: E402

REPORT_EVERY_S = 1.0
LOWEST_NICE = 19
"""Lowest priority: runs only where nothing else wants the processor."""
SWITCH_S = 5e-4
"""Switch interval of the interpreter, so that background threads yield to the tracker."""


def main() -> int:
    """Run one stage until told to finish, or until the daemon is gone."""
    kind, nice, pipe_fd, ring_fd = sys.argv[1], *map(int, sys.argv[2:5])
    os.nice(min(nice, LOWEST_NICE))
    if kind == "localisation":
        _take_real_time()
    if nice > LOWEST_NICE:
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    sys.setswitchinterval(SWITCH_S)
    pipe: Connection[Any, Any] = Connection(pipe_fd)
    module = module_of(kind)  # which takes a second, and may be long before there is a flight
    try:
        setup: Setup = pipe.recv()
    except EOFError:
        return 0
    send = _sender(pipe)
    try:
        _serve(pipe, send, module, setup, ring_fd)
    except (CompanionError, OSError) as error:  # no device, no room on the disk: no bug of ours
        send(Failed(str(error), isinstance(error, InputError)))
        return 1
    return 0


def _serve(
    pipe: Connection[Any, Any],
    send: Callable[[Any], None],
    module: WorkModule,
    setup: Setup,
    ring_fd: int,
) -> None:
    ring = FrameRing(setup.camera.width, setup.camera.height, ring_fd)
    work = module.work(setup)
    work.begin(send)
    send(Progress(device=work.device))
    loop = _Loop(ring, work)
    threading.Thread(target=loop.read, args=(pipe,), name="from the daemon", daemon=True).start()
    threading.Thread(target=loop.report, args=(send,), name="reports", daemon=True).start()
    loop.run(send)
    send(Finished(work.times.summary(), work.device))


class _Loop:
    """Processes one message after the other, and reports progress, also of a step that hangs."""

    def __init__(self, ring: FrameRing, work: Work) -> None:
        self._ring, self._work = ring, work
        self._inbox: Mailbox[Any] = Mailbox(
            lambda message: drop_policy_of(message, work.latest_only), size_bytes, IN_BYTES
        )
        self._n_done = 0
        self._n_overwritten = 0
        """Frames overwritten in the ring or dropped on overflow."""
        self._busy_since_s: float | None = None

    def read(self, pipe: Connection[Any, Any]) -> None:
        """Put incoming messages into the inbox, frames copied, until the daemon is gone."""
        ring, work = self._ring, self._work
        try:
            while True:
                message = pipe.recv()
                if isinstance(message, FrameHandle) and not work.latest_only:
                    capacity = self._inbox.n_bytes + ring.frame_bytes <= FRAMES_SHARE * IN_BYTES
                    frame = ring.get(message) if capacity or not len(self._inbox) else None
                    if frame is None:
                        self._n_overwritten += 1
                        continue
                    message = frame
                self._inbox.put(message)
        except (OSError, EOFError):
            if not work.outlives_daemon:
                os._exit(0)  # the daemon is gone, and nobody waits for results
            self._inbox.put(Finish(hurry=True))

    def report(self, send: Callable[[Any], None]) -> None:
        """Report progress periodically, as long as the process lives."""
        while True:
            wait_s(threading.Event(), REPORT_EVERY_S)
            inbox, work = self._inbox, self._work
            n_dropped = inbox.n_dropped + inbox.n_overflowed + self._n_overwritten
            send(
                Progress(
                    self._n_done, n_dropped + work.n_rejected, self._busy_since_s,
                    inbox.n_bytes, work.times.summary(), work.device,
                )
            )  # fmt: skip

    def run(self, send: Callable[[Any], None]) -> None:
        """Work until told to finish."""
        work = self._work
        while True:
            self._busy_since_s = None
            message = self._inbox.get()
            self._busy_since_s = monotonic_s()
            if isinstance(message, Finish):
                for out in work.finish(message):
                    send(out)
                return
            if isinstance(message, FrameHandle):
                frame = self._ring.get(message, colour=False)
                if frame is None:
                    self._n_overwritten += 1
                    continue
                message = frame
            for out in work.step(message):
                send(out)
            self._n_done += isinstance(message, Frame)


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


def _sender(pipe: Connection[Any, Any]) -> Callable[[Any], None]:
    lock = threading.Lock()

    def send(message: Any) -> None:
        data = pickle.dumps(message, pickle.HIGHEST_PROTOCOL)
        try:
            with lock:
                pipe.send_bytes(data)
        except OSError:
            pass  # the daemon is gone, which the reader sees

    return send


if __name__ == "__main__":
    status = main()
    sys.stderr.flush()
    os._exit(status)  # no library has a say in whether this ends
