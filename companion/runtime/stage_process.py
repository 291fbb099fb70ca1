"""Handle of a stage's process in the daemon.

Messages go through a pair of sockets as pickles (both ends are ours, and nobody else has them),
frames through shared memory. Nothing here makes the caller wait but `wait`.
"""

from __future__ import annotations

import pickle
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from companion.runtime.frame_ring import FrameRing
from companion.runtime.mail_policy import OUT_BYTES, drop_policy_of
from companion.runtime.mailbox import Mailbox
from companion.runtime.message_size import size_bytes
from companion.runtime.stage_protocol import DriverAtWork, Failed, Finish, Finished, Progress, Setup
from companion.timing.clock import monotonic_s

CHILD = "companion.runtime.stage_child"
BY_DRIVER = (
    signal.SIGABRT, signal.SIGALRM, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGSEGV,
)  # fmt: skip
"""Signals of a driver's crash; SIGALRM where a driver does not return."""


class StageProcess:
    """Starts the process of a stage, which does nothing before `begin`.

    `deliver` gets its messages, and `ended` one call when it is gone: "" where it was asked to end,
    else the reason in words. Both are called from a thread of this object. With `every_frame` no
    frame is dropped for a newer one.
    """

    def __init__(
        self,
        kind: str,
        nice: int,
        ring: FrameRing,
        deliver: Callable[[Any], None],
        ended: Callable[[str], None],
        every_frame: bool = False,
    ) -> None:
        self.name = kind
        self.progress: Progress | None = None
        """None until the stage is ready."""
        self.finished: Finished | None = None
        self.failed: Failed | None = None
        self._interrupted: str | None = None
        self._begun_s: float | None = None
        self._busy_since_s: float | None = None
        """By its last report."""
        self._offered_s: float | None = None
        """Time of the first message since it last reported that it waits."""
        self._deliver, self._ended = deliver, ended
        self.asked_to_end = False
        """Whether it was asked to finish or killed."""
        self._driver = DriverAtWork()
        self._outbox: Mailbox[Any] = Mailbox(
            lambda message: drop_policy_of(message, not every_frame), size_bytes, OUT_BYTES
        )
        ours, theirs = socket.socketpair()
        self._child = subprocess.Popen(
            [sys.executable, "-m", CHILD, kind, str(nice), str(theirs.fileno()), str(ring.fd)],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
            pass_fds=(theirs.fileno(), ring.fd),
        )  # fmt: skip
        theirs.close()
        self._pipe = Connection(ours.detach())
        self._writer = threading.Thread(target=self._write, name=f"to {self.name}", daemon=True)
        self._reader = threading.Thread(target=self._read, name=f"from {self.name}", daemon=True)
        self._writer.start()
        self._reader.start()

    @property
    def pid(self) -> int:
        """Process id."""
        return self._child.pid

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._child.poll() is None

    @property
    def n_dropped(self) -> int:
        """Frames dropped before or in the process."""
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
        self._outbox.put(setup)
        self._begun_s = monotonic_s()

    def offer(self, message: Any) -> None:
        """Send a message or a FrameHandle; a waiting frame is dropped for a newer one.

        Where more than OUT_BYTES wait, depth maps are dropped first; see companion.runtime.mailbox.
        """
        if self._begun_s is None:
            return
        self._outbox.put(message)
        if self._offered_s is None:
            self._offered_s = monotonic_s()

    def ask_to_finish(self, finish: Finish) -> None:
        """Ask it for its last results and its end."""
        self.asked_to_end = True
        self._outbox.put(finish)
        self._outbox.close()

    def wait(self, seconds: float) -> bool:
        """Wait until it has ended, at most this long; whether it has."""
        self._reader.join(seconds)
        return not self._reader.is_alive()

    @property
    def was_interrupted(self) -> bool:
        """Whether it was ended by `interrupt`."""
        return self._interrupted is not None

    def interrupt(self, why: str = "") -> None:
        """End it as if it had died by itself: `ended` is called, with this reason if given."""
        self._interrupted = why
        self._child.kill()

    @property
    def driver(self) -> DriverAtWork | None:
        """Driver that was at work when the process ended of itself or was interrupted."""
        status = self._child.poll()
        if status is None or self.failed is not None or not self._driver.identity:
            return None
        by_itself = status >= 0 or -status in BY_DRIVER
        return self._driver if by_itself or self.was_interrupted else None

    def kill(self) -> None:
        """End it now."""
        self.asked_to_end = True
        self._outbox.close()
        if self._child.poll() is None:
            self._child.kill()
        self._child.wait()
        for thread in (self._reader, self._writer):
            if thread is not threading.current_thread():
                thread.join()
        self._pipe.close()

    def _write(self) -> None:
        try:
            while (message := self._outbox.get()) is not None:
                self._pipe.send_bytes(pickle.dumps(message, pickle.HIGHEST_PROTOCOL))
        except OSError:
            pass  # it is gone, which the reader tells

    def _read(self) -> None:
        try:
            while True:
                message = self._pipe.recv()
                if isinstance(message, Progress):
                    self._busy_since_s = message.busy_since_s
                    self._offered_s = None
                    self.progress = message
                elif isinstance(message, DriverAtWork):
                    self._driver = message
                elif isinstance(message, Failed):
                    self.failed = message
                elif isinstance(message, Finished):
                    self.finished = message
                else:
                    self._deliver(message)
        except (OSError, EOFError):
            pass
        self._outbox.close()
        status = self._child.wait()
        why = self.failed.why if self.failed is not None else self._interrupted
        why = why or _in_words(status)
        self._ended("" if self.asked_to_end else why)


def _in_words(status: int) -> str:
    if status == -signal.SIGALRM:
        return "a driver does not come back"
    if status < 0:
        return f"killed by {signal.Signals(-status).name}"
    return f"ended with status {status}"
