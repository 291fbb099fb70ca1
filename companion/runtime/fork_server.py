"""Fork server: processes of stages begin as copies of one that has imported what all need.

Its pages are shared until somebody writes to them, and a stage starts without these imports. The
server is a process of one thread (`fork_server_process`), which nothing else is asked of. A request
carries the socket of the stage and one for answers: the child's id and handle (pidfd_open(2)), and
at its end its status. Stages outlive a server that dies; later ones are started by themselves.
"""

from __future__ import annotations

import contextlib
import gc
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
from types import TracebackType

from companion.runtime.stage_start import NOT_STARTED, UNKNOWN_STATUS, Child, start_alone

SERVER = "companion.runtime.fork_server_process"
ANSWER = struct.Struct("<q")
"""The child's id; then its status."""
NAME_BYTES = 256
END_S = 1.0
ANSWER_S = 5.0
"""Longest wait for a status from a server that is stopped; one that has died is known at once."""


class ForkServer:
    """Starts processes of stages, from any thread, without waiting for them; see the module.

    With `copy` the server is itself a copy of this program, where that has one thread so far: they
    share what both import. It also has each file that is open now.
    """

    def __init__(self, copy: bool = False) -> None:
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._process: subprocess.Popen[bytes] | _Copy
        with theirs:
            if copy and len(os.listdir("/proc/self/task")) == 1:
                self._process = _Copy(self._control, theirs)
                return
            self._process = subprocess.Popen(
                [sys.executable, "-m", SERVER, str(theirs.fileno())],
                stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, pass_fds=(theirs.fileno(),),
            )  # fmt: skip

    def prepare(self, name: str) -> None:
        """Have a process import what a stage needs, and wait until that stage is started."""
        with contextlib.suppress(OSError):  # a server that is gone is told of when a stage starts
            self._control.send(name.encode())

    def start(self, name: str, descriptor: int) -> Child:
        """Start the process of a stage, with the descriptor of its socket."""
        answers, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            try:
                socket.send_fds(self._control, [name.encode()], [theirs.fileno(), descriptor])
            except OSError as error:
                answers.close()
                # slower and larger, but it has no need of what died for reasons that nobody knows
                text = f"companion: the fork server is gone ({error.strerror}): {name} starts alone"
                print(text, file=sys.stderr, flush=True)
                return start_alone(name, descriptor)
        return _Forked(answers)

    @property
    def pid(self) -> int:
        """Process id of the server."""
        return self._process.pid

    def close(self) -> None:
        """End the server, once all that it has started has ended; does not wait long."""
        self._control.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(END_S)

    def __enter__(self) -> ForkServer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:  # fmt: skip
        self.close()


class _Copy:
    """A server that is a copy of this program; as subprocess.Popen."""

    def __init__(self, own: socket.socket, theirs: socket.socket) -> None:
        gc.disable()
        from companion.runtime.fork_server_process import serve  # what both share

        gc.freeze()
        self.pid = os.fork()
        if self.pid == 0:
            own.close()
            nowhere = os.open(os.devnull, os.O_RDWR)
            os.dup2(nowhere, 0)
            os.dup2(nowhere, 1)
            serve(theirs)
        gc.enable()

    def wait(self, timeout: float) -> int:
        """Wait until it has ended; TimeoutExpired where it has not in time."""
        handle = os.pidfd_open(self.pid)
        try:
            if not _is_readable(handle, timeout):
                raise subprocess.TimeoutExpired("fork server", timeout)
        finally:
            os.close(handle)
        return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])


class _Forked:
    """A child of the server, whose handle tells its end, and the server its status.

    It never waits for the server but in its own thread, and in `wait`.
    """

    def __init__(self, answers: socket.socket) -> None:
        self._answers = answers
        self._pid: int | None = None
        self._status: int | None = None
        self._handle: int | None = None
        self._is_unwanted = False
        self._lock, self._ended = threading.Lock(), threading.Event()
        try:
            threading.Thread(target=self._listen, name="forked", daemon=True).start()
        except RuntimeError:  # too many threads
            answers.close()
            raise

    @property
    def pid(self) -> int | None:
        return self._pid

    def poll(self) -> int | None:
        return self._status

    def wait(self) -> int:
        self._ended.wait()
        assert self._status is not None
        return self._status

    def kill(self) -> None:
        with self._lock:
            self._is_unwanted = True
            if self._handle is not None:
                self._signal()
            else:
                with contextlib.suppress(OSError):  # it counts as not started; the server ends one
                    self._answers.shutdown(socket.SHUT_RDWR)  # of which it cannot tell any more

    def _signal(self) -> None:
        assert self._handle is not None
        with contextlib.suppress(ProcessLookupError):
            signal.pidfd_send_signal(self._handle, signal.SIGKILL)

    def _listen(self) -> None:
        status: int | None = NOT_STARTED
        pid, handle = self._answer()
        if handle is not None:
            with self._lock:
                self._pid, self._handle = pid, handle
                if self._is_unwanted:  # the answer was on its way
                    self._signal()
            _is_readable(handle)  # which is its end
            told = _is_readable(self._answers.fileno(), ANSWER_S)
            status = self._answer()[0] if told else None
        with self._lock:
            self._answers.close()
            self._handle = None
            if handle is not None:
                os.close(handle)
        self._status = UNKNOWN_STATUS if status is None else status
        self._ended.set()

    def _answer(self) -> tuple[int | None, int | None]:
        """A number and a descriptor; None for what did not come."""
        try:
            packet, handles, _flags, _address = socket.recv_fds(self._answers, ANSWER.size, 1)
        except OSError:
            return None, None
        return ANSWER.unpack(packet)[0] if packet else None, handles[0] if handles else None


def _is_readable(descriptor: int, patience_s: float | None = None) -> bool:
    """Wait until there is something to read, or the end; whether there is in time."""
    waiting = select.poll()
    waiting.register(descriptor, select.POLLIN)
    return bool(waiting.poll(None if patience_s is None else 1000 * patience_s))
