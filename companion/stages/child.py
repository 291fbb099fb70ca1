"""The process of a stage: python -m companion.stages.child KIND NICE SOCKET_FD RING_FD."""

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

from companion.clock import monotonic_s  # noqa: E402
from companion.errors import CompanionError, InputError  # noqa: E402
from companion.latest import LatestWins  # noqa: E402
from companion.messages import Frame  # noqa: E402
from companion.stages.frame_ring import FrameInRing, FrameRing  # noqa: E402
from companion.stages.protocol import Failed, Finish, Finished, Progress, Setup  # noqa: E402
from companion.stages.work import WorkModule, module_of  # noqa: E402

REPORT_EVERY_S = 1.0
LOWEST_NICE = 19
"""What is nicer still runs only where nothing else wants the processor."""
SWITCH_S = 5e-4
"""What works beside the tracker gives it the interpreter so soon."""


def main() -> int:
    """Serve one stage until told to finish, or until the daemon is gone."""
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
    inbox: LatestWins[Any] = LatestWins(work.may_skip)
    n_overwritten = 0

    def read() -> None:
        nonlocal n_overwritten
        try:
            while True:
                message = pipe.recv()
                if isinstance(message, FrameInRing) and not work.latest_only:
                    frame = ring.get(message) if work.has_room else None
                    if frame is None:
                        n_overwritten += 1
                        continue
                    message = frame
                    work.n_held += 1
                inbox.put(message)
        except (OSError, EOFError):
            if not work.outlives_daemon:
                os._exit(0)  # the daemon is gone, and nobody waits for results
            inbox.put(Finish(hurry=True))

    threading.Thread(target=read, name="from the daemon", daemon=True).start()
    reported_s = monotonic_s()
    n_done = 0
    while (message := inbox.get()) is not None:
        if isinstance(message, Finish):
            for out in work.finish(message):
                send(out)
            break
        if isinstance(message, FrameInRing):
            frame = ring.get(message, colour=False)
            if frame is None:
                n_overwritten += 1
                continue
            message = frame
        elif isinstance(message, Frame):
            work.n_held -= 1
        for out in work.step(message):
            send(out)
        n_done += isinstance(message, Frame)
        if monotonic_s() - reported_s > REPORT_EVERY_S:
            reported_s = monotonic_s()
            n_dropped = inbox.n_dropped + n_overwritten + work.n_turned_away
            send(Progress(n_done, n_dropped, work.times.summary(), work.device))
    send(Finished(work.times.summary(), work.device))


def _take_real_time() -> None:
    """The pose before all else, where the service's LimitRTPRIO allows it and a core is left over.

    Only what takes a frame to its pose: threads that this one starts have the usual policy again.
    """
    if resource.getrlimit(resource.RLIMIT_RTPRIO)[0] == 0 or len(os.sched_getaffinity(0)) < 2:
        return
    try:
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(1))
    except OSError as error:  # some kernels let no group of processes have it
        print(f"companion: no real-time policy for the pose: {error.strerror}", file=sys.stderr)


def _sender(pipe: Connection[Any, Any]) -> Callable[[Any], None]:
    def send(message: Any) -> None:
        try:
            pipe.send_bytes(pickle.dumps(message, pickle.HIGHEST_PROTOCOL))
        except OSError:
            pass  # the daemon is gone, which the reader sees

    return send


if __name__ == "__main__":
    status = main()
    sys.stderr.flush()
    os._exit(status)  # no library has a say in whether this ends
