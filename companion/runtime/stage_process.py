"""Handle of a stage's process in the daemon.

Parcels go through a pair of sockets; both ends are ours, and nobody else has them. Nothing here
makes the caller wait but `wait`.
"""

from __future__ import annotations

import contextlib
import signal
import socket
import threading
from collections.abc import Callable
from functools import cache
from typing import Any

from companion.messages import Frame
from companion.runtime.mailbox import Mailbox
from companion.runtime.parcel import INLINE_BYTES, Parcel
from companion.runtime.stage_protocol import (
    DriverAtWork,
    Failed,
    Finish,
    Finished,
    Progress,
    Setup,
    Taken,
)
from companion.runtime.stage_start import NOT_STARTED, UNKNOWN_STATUS, Start
from companion.runtime.stages import QUEUE_BYTES, UNREAD_BYTES, Frames, Stage, drop_policy
from companion.telemetry import TELEMETRY
from companion.timing.clock import monotonic_s

FRAME = Frame.__name__
GATHER_S = 0.05
"""Small messages gather for this long, or until a frame;"""
HELD_S = 0.02
"""samples for localisation, which takes them with its next frame only, for this long: a frame never
waits for more than a few of them to be opened."""
MOST_HELD = 64
"""Samples of some 200 bytes each: a packet holds INLINE_BYTES of them."""
SAMPLES = {kind.__name__ for kind in TELEMETRY}
BY_DRIVER = (
    signal.SIGABRT, signal.SIGALRM, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGSEGV,
)  # fmt: skip
"""Signals of a driver's crash; SIGALRM where a driver does not return."""


class StageProcess:
    """Starts the process of a stage, which does nothing before `begin`.

    `deliver` gets its messages, closed, and `ended` one call when it is gone: "" where it was asked
    to end, else the reason in words. Both are called from a thread of this object.
    """

    def __init__(
        self, stage: Stage, start: Start, deliver: Callable[[Parcel], None],
        ended: Callable[[str], None],
    ) -> None:  # fmt: skip
        self.stage = stage
        self.progress: Progress | None = None
        """None until the stage is ready."""
        self.finished: Finished | None = None
        self.failed: Failed | None = None
        self._interrupted: str | None = None
        self._not_sent = ""
        """Reason why it gets nothing more, which is not its own end."""
        self._begun_s: float | None = None
        self._busy_since_s: float | None = None
        """By its last report."""
        self._offered_s: float | None = None
        """Time of the first message since it last reported that it waits."""
        self._deliver, self._ended = deliver, ended
        self.asked_to_end = False
        """True once it was asked to finish, or killed."""
        self._driver = DriverAtWork()
        self._frame_ns = -(2**63)
        self._n_sent = self._n_taken = 0
        """Bytes of shared memory, so far."""
        self._was_taken = threading.Condition()
        self._gone = False
        policy = cache(lambda kind: drop_policy(stage, kind, in_daemon=True))
        self._outbox: Mailbox[Parcel] = Mailbox(
            lambda parcel: policy(parcel.kind), lambda parcel: parcel.n_bytes, QUEUE_BYTES
        )
        self._is_prompt = stage.frames is Frames.NEWEST
        self._held: list[Parcel] = []
        """Samples that gather for one packet."""
        self._held_since_s = 0.0
        self._puts = threading.Lock()
        """Keeps what is sent at once in order with what waits."""
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
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
        return self._outbox.n_dropped + self._outbox.n_overflowed + inside

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
        with self._puts:
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
        self._put(parcel)
        if self._offered_s is None:
            self._offered_s = monotonic_s()

    def order(self, control: Any) -> None:
        """Send a control message, which is never dropped."""
        self.offer(Parcel.of(control))

    def ask_to_finish(self, finish: Finish) -> None:
        """Ask it for its last results and its end."""
        self.asked_to_end = True
        with self._puts:
            self._let_go()
            self._outbox.put(Parcel.of(finish))
            self._outbox.close()

    def wait(self, seconds: float) -> bool:
        """Wait until it has ended, at most this long; whether it has."""
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
        if status is None or self.failed is not None or not self._driver.identity:
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

    def _put(self, parcel: Parcel) -> None:
        """Send a message now where nothing waits and the socket takes it, else let it wait.

        Handing it over to the thread that sends costs more than sending it.
        """
        if not self._is_prompt:
            self._outbox.put(parcel)
            return
        with self._puts:
            if parcel.kind not in SAMPLES:
                self._let_go()
                self._go([parcel])
                return
            now_s = monotonic_s()
            if not self._held:
                self._held_since_s = now_s
            self._held.append(parcel)
            if now_s - self._held_since_s >= HELD_S or len(self._held) >= MOST_HELD:
                self._let_go()

    def _let_go(self) -> None:
        """Send the samples that have gathered."""
        if self._held:
            held, self._held = self._held, []
            self._go(held)

    def _go(self, parcels: list[Parcel]) -> None:
        if not (self._outbox.is_idle and self._are_sent(parcels)):
            for parcel in parcels:
                self._outbox.put(parcel)

    def _are_sent(self, parcels: list[Parcel]) -> bool:
        """Send messages in one packet without waiting; whether they could be."""
        first = parcels[0]
        if first.is_shared and self._n_sent - self._n_taken > UNREAD_BYTES:
            return False
        try:
            Parcel.send_together(parcels, self._socket, socket.MSG_DONTWAIT)
        except OSError:  # full, or gone, of which the thread that sends will learn
            return False
        if first.is_shared:
            self._n_sent += first.n_bytes  # the thread that counts them else waits for a message
        return True

    def _write(self) -> None:
        try:
            pause_s = 0.0 if self._is_prompt else GATHER_S
            while parcels := self._outbox.collect(INLINE_BYTES, pause_s):
                if parcels[0].is_shared and not self._has_room(parcels[0].n_bytes):
                    return
                Parcel.send_together(parcels, self._socket)
        except ConnectionError:
            pass  # it is gone, which the reader tells
        except OSError as error:  # no memory in the kernel, or too many descriptors on their way
            self._not_sent = f"nothing can be sent to it: {error.strerror}"
            self._hang_up()  # it would live on and get nothing

    def _has_room(self, n_bytes: int) -> bool:
        """Wait until little is on its way; False where it is gone."""
        with self._was_taken:
            self._was_taken.wait_for(
                lambda: self._gone or self._n_sent - self._n_taken <= UNREAD_BYTES
            )
            self._n_sent += n_bytes
            return not self._gone

    def _read(self) -> None:
        try:
            while True:
                for parcel in Parcel.receive(self._socket):
                    self._take(parcel)
        except (OSError, EOFError):
            pass
        self._outbox.close()
        with self._was_taken:
            self._gone = True
            self._was_taken.notify()
        status = self._child.wait()
        why = self.failed.why if self.failed is not None else self._interrupted
        why = why or self._not_sent or _in_words(status)
        self._ended("" if self.asked_to_end else why)

    def _take(self, parcel: Parcel) -> None:
        if parcel.kind not in REPORTS:
            self._deliver(parcel)
            return
        report = parcel.open()
        if isinstance(report, Taken):
            with self._was_taken:
                self._n_taken = report.n_bytes
                self._was_taken.notify()
        elif isinstance(report, Progress):
            self._busy_since_s = report.busy_since_s
            self._offered_s = None
            self.progress = report
        elif isinstance(report, DriverAtWork):
            self._driver = report
        elif isinstance(report, Failed):
            self.failed = report
        elif isinstance(report, Finished):
            self.finished = report


REPORTS = {kind.__name__ for kind in (Taken, Progress, DriverAtWork, Failed, Finished)}


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
