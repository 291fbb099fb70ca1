"""Handle of a stage's process in the daemon.

Parcels go through a pair of sockets; both ends are ours, and nobody else has them. Nothing here
makes the caller wait but `wait`.
"""

from __future__ import annotations

import contextlib
import signal
import socket
import sys
import threading
from collections.abc import Callable
from typing import Any

from companion.messages import Frame
from companion.runtime.parcel import Parcel
from companion.runtime.stage_outbox import StageOutbox
from companion.runtime.stage_protocol import (
    DriverAtWork,
    Failed,
    Finish,
    Finished,
    Progress,
    Remark,
    Setup,
    Taken,
)
from companion.runtime.stage_start import NOT_STARTED, UNKNOWN_STATUS, Start
from companion.runtime.stages import Stage, lossless
from companion.timing.clock import monotonic_s

FRAME = Frame.__name__
BY_DRIVER = (
    signal.SIGABRT, signal.SIGALRM, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGSEGV,
)  # fmt: skip
"""Signals of a driver's crash; SIGALRM where a driver does not return."""


def to_stderr(text: str) -> None:
    """Print a remark of a stage, whose caller has no better place for it."""
    print(f"companion: {text}", file=sys.stderr, flush=True)


class StageProcess:
    """Starts the process of a stage, which does nothing before `begin`.

    `deliver` gets its messages, closed, and `ended` one call when it is gone: "" where it was asked
    to end, else the reason in words. Both are called from a thread of this object, and `say` with
    its remarks. With `waits` nothing is dropped: `offer` waits for room.
    """

    def __init__(
        self, stage: Stage, start: Start, deliver: Callable[[Parcel], None],
        ended: Callable[[str], None], say: Callable[[str], None] = to_stderr, waits: bool = False,
    ) -> None:  # fmt: skip
        self.stage = stage
        self.progress: Progress | None = None
        """None until the stage is ready."""
        self.has_finished = False
        """True once all its results are given."""
        self.failed: Failed | None = None
        self._interrupted: str | None = None
        self._not_sent = ""
        """Reason why it gets nothing more, which is not its own end."""
        self._begun_s: float | None = None
        self._busy_since_s: float | None = None
        """By its last report."""
        self._offered_s: float | None = None
        """Time of the first message since it last reported that it waits."""
        self._deliver, self._ended, self._say = deliver, ended, say
        self.up_or_gone = threading.Event()
        self.why = ""
        """Reason why it has ended, also where it was asked to; "" as long as it runs."""
        self.asked_to_end = False
        """True once it was asked to finish, or killed."""
        self._driver = DriverAtWork()
        self._frame_ns = -(2**63)
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._outbox = StageOutbox(lossless(stage) if waits else stage, self._socket, waits)
        with theirs:
            try:
                self._child = start(stage.name, theirs.fileno())
            except BaseException:
                self._socket.close()
                raise
        self._writer = threading.Thread(target=self._write, name=f"to {stage.name}", daemon=True)
        self._reader = threading.Thread(target=self._read, name=f"from {stage.name}", daemon=True)
        try:
            self._writer.start()
            self._reader.start()
        except RuntimeError:  # too many threads
            self._outbox.close()
            self._end()
            self._child.wait()
            self._socket.close()
            raise

    @property
    def pid(self) -> int | None:
        """Process id; None as long as it is not known."""
        return self._child.pid

    @property
    def alive(self) -> bool:
        """True while the process runs."""
        return self._child.poll() is None

    @property
    def n_dropped(self) -> int:
        """Messages dropped before or in the process, frames most of all."""
        inside = self.progress.n_dropped if self.progress is not None else 0
        return self._outbox.n_dropped + inside

    @property
    def waiting_bytes(self) -> int:
        """Bytes of messages that wait, here and in the process."""
        inside = self.progress.waiting_bytes if self.progress is not None else 0
        return self._outbox.n_bytes + inside

    def stalled_s(self, now_s: float) -> float:
        """Seconds in its present step, or without reading its input, or starting.

        0 where it waits for work, or was asked to end. A process that is stopped or hangs in a
        driver reports nothing more, and its last report ages.
        """
        if self.asked_to_end or self._begun_s is None or self._interrupted is not None:
            return 0.0
        since_s = self._begun_s if self.progress is None else self._busy_since_s or self._offered_s
        return max(0.0, now_s - since_s) if since_s is not None else 0.0

    def begin(self, setup: Setup) -> None:
        """Send the setup; earlier messages are ignored."""
        self._outbox.put(Parcel.of(setup))
        self._begun_s = monotonic_s()

    def offer(self, parcel: Parcel) -> None:
        """Send a message; a waiting frame is dropped for a newer one.

        Where more than QUEUE_BYTES wait, depth maps are dropped first; see runtime.mailbox.
        """
        if self._begun_s is None:
            return
        if parcel.kind == FRAME:
            if parcel.t_ns - self._frame_ns < self.stage.frame_every_ns:
                return
            self._frame_ns = parcel.t_ns
        self._outbox.put(parcel)
        if self._offered_s is None:
            self._offered_s = monotonic_s()

    def order(self, control: Any) -> None:
        """Send a control message, which is never dropped."""
        self.offer(Parcel.of(control))

    def ask_to_finish(self, finish: Finish) -> None:
        """Ask it for its last results and its end."""
        self.asked_to_end = True
        self._outbox.put(Parcel.of(finish))
        self._outbox.close()

    def wait(self, seconds: float | None = None) -> bool:
        """Wait until it has ended, at most this long if given; whether it has."""
        self._reader.join(seconds)
        return not self._reader.is_alive()

    @property
    def was_interrupted(self) -> bool:
        """True if it was ended by `interrupt`."""
        return self._interrupted is not None

    def interrupt(self, why: str = "") -> None:
        """End it as if it had died by itself: `ended` is called, with this reason if given."""
        self._interrupted = why
        self._end()

    @property
    def driver(self) -> DriverAtWork | None:
        """Driver that was at work when the process ended of itself or was interrupted."""
        status = self._child.poll()
        has_said_why = self.failed is not None and self.failed.is_foreseen
        if status is None or has_said_why or not self._driver.identity:
            return None
        if self._not_sent and not self.was_interrupted:
            return None
        by_itself = 0 <= status < UNKNOWN_STATUS or -status in BY_DRIVER
        return self._driver if by_itself or self.was_interrupted else None

    def kill(self) -> None:
        """End it now."""
        self.asked_to_end = True
        self._outbox.close()
        self._end()
        self._child.wait()
        for thread in (self._reader, self._writer):
            if thread is not threading.current_thread():
                thread.join()
        self._socket.close()

    def _end(self) -> None:
        self._child.kill()
        self._hang_up()  # nobody else closes the socket of one never started

    def _hang_up(self) -> None:
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)

    def _write(self) -> None:
        self._not_sent = self._outbox.send_all()
        if self._not_sent:
            self._hang_up()  # it would live on and get nothing

    def _read(self) -> None:
        while True:
            try:
                parcels = Parcel.receive(self._socket)
            except (OSError, EOFError):
                break
            for parcel in parcels:
                self._take(parcel)
        self._outbox.hear_gone()
        status = self._child.wait()
        why = self.failed.why if self.failed is not None else self._interrupted
        self.why = why or self._not_sent or _in_words(status)
        self.up_or_gone.set()
        self._ended("" if self.asked_to_end else self.why)

    def _take(self, parcel: Parcel) -> None:
        if parcel.kind not in REPORTS:
            self._deliver(parcel)
            return
        report = parcel.open()
        if isinstance(report, Taken):
            self._outbox.hear_taken(report.n_bytes)
        elif isinstance(report, Progress):
            self._busy_since_s = report.busy_since_s
            self._offered_s = None
            self.progress = report
            self.up_or_gone.set()
        elif isinstance(report, Remark):
            self._say(report.text)
        elif isinstance(report, DriverAtWork):
            self._driver = report
        elif isinstance(report, Failed):
            self.failed = report
        elif isinstance(report, Finished):
            self.has_finished = True


REPORTS = {kind.__name__ for kind in (Taken, Progress, Remark, DriverAtWork, Failed, Finished)}


def _in_words(status: int) -> str:
    if status == NOT_STARTED:
        return "its process could not be started"
    if status == UNKNOWN_STATUS:
        return "ended, and the fork server does not say how"
    if status == -signal.SIGALRM:
        return "a driver does not come back"
    if status < 0:
        return f"killed by {signal.Signals(-status).name}"
    return f"ended with status {status}"
