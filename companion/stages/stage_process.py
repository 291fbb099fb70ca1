"""A stage in a process of its own, seen from the daemon.

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

from companion.clock import monotonic_s
from companion.latest import LatestWins
from companion.stages.frame_ring import FrameInRing, FrameRing
from companion.stages.protocol import DriverAtWork, Failed, Finish, Finished, Progress, Setup

CHILD = "companion.stages.child"
BY_DRIVER = (
    signal.SIGABRT, signal.SIGALRM, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGSEGV,
)  # fmt: skip
"""What ends a process from within; SIGALRM where a driver does not come back."""


class StageProcess:
    """Starts the process of a stage, which does nothing before `begin`.

    `deliver` gets its messages, and `ended` one call when it is gone. Both are called from a
    thread of this object. `ended` gets "" where it was asked to end, else what became of the
    process, in words. With `every_frame` no frame gives way to a newer one.
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
        self.heard_s = monotonic_s()
        """When it last gave a sign of its work."""
        self._deliver, self._ended = deliver, ended
        self.asked_to_end = False
        """Whether it was told to end, one way or the other."""
        self.was_interrupted = False
        self._driver = DriverAtWork()
        self._begun = False
        self._outbox: LatestWins[Any] = LatestWins(
            lambda message: not every_frame and isinstance(message, FrameInRing)
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
        """Of the process."""
        return self._child.pid

    @property
    def alive(self) -> bool:
        """Whether it runs."""
        return self._child.poll() is None

    @property
    def n_dropped(self) -> int:
        """Frames that it did not get or did not get round to."""
        inside = self.progress.n_dropped if self.progress is not None else 0
        return self._outbox.n_dropped + self._outbox.n_overflown + inside

    def begin(self, setup: Setup) -> None:
        """Say what to do; what is offered before is not for it."""
        self._outbox.put(setup)
        self._begun = True

    def offer(self, message: Any) -> None:
        """Hand over a message or a FrameInRing; a frame that waits gives way to a newer one."""
        if self._begun:
            self._outbox.put(message)

    def ask_to_finish(self, finish: Finish) -> None:
        """Have it give its last results and end."""
        self.asked_to_end = True
        self._outbox.put(finish)
        self._outbox.close()

    def wait(self, seconds: float) -> bool:
        """Wait until it has ended, at most so long; whether it has."""
        self._reader.join(seconds)
        return not self._reader.is_alive()

    def interrupt(self) -> None:
        """End it as if it had died by itself: `ended` hears of it."""
        self.was_interrupted = True
        self._child.kill()

    @property
    def driver(self) -> DriverAtWork | None:
        """The driver that was at work when the process ended of itself or was interrupted."""
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
                    self.progress = message
                    self.heard_s = monotonic_s()
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
        why = self.failed.why if self.failed is not None else _in_words(status)
        self._ended("" if self.asked_to_end else why)


def _in_words(status: int) -> str:
    if status == -signal.SIGALRM:
        return "a driver does not come back"
    if status < 0:
        return f"killed by {signal.Signals(-status).name}"
    return f"ended with status {status}"
