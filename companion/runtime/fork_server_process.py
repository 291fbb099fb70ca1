"""The process of the fork server: python -m companion.runtime.fork_server_process SOCKET_FD.

A single thread, so that a copy of it is whole. What it imports all stages need; what one of them
only needs that one imports, once it is a process of its own.
"""

from __future__ import annotations

import gc

if __name__ == "__main__":
    gc.disable()  # what is freed between imports would leave holes for the copies to write into

import os
import select
import socket
import sys
from pathlib import Path
from signal import SIGKILL
from typing import NoReturn

from companion.runtime.fork_server import ANSWER, NAME_BYTES
from companion.runtime.parcel import allow_descriptors
from companion.runtime.stage_child import imported, run
from companion.runtime.stage_start import ignore_signals
from companion.timing.clock import monotonic_s

ORPHANS_S = 60.0
"""Time for stages to finish once the daemon is gone: a recording is completed. Then they are
ended, since one that hangs would stay for ever."""


class _Server:
    def __init__(self, control: socket.socket) -> None:
        self._control = control
        self._poll = select.poll()
        self._poll.register(control, select.POLLIN)
        self._children: dict[int, tuple[int, socket.socket]] = {}
        """By handle: process id, and where its status goes."""
        self._prepared: dict[str, tuple[int, socket.socket]] = {}
        """By stage: a process that has imported what it needs, and what its socket is sent by."""
        self._gone_s: float | None = None
        """Time when the daemon went."""

    def run(self) -> None:
        """Serve until the daemon and all children are gone."""
        while self._gone_s is None or self._children:
            for descriptor, _ in self._poll.poll(None if self._gone_s is None else 1000):
                if descriptor in self._children:
                    self._tell_end(descriptor)
                else:
                    self._hear()
            if self._gone_s is not None and monotonic_s() > self._gone_s + ORPHANS_S:
                for pid, _ in self._children.values():
                    os.kill(pid, SIGKILL)

    def _hear(self) -> None:
        packet, descriptors, _flags, _address = socket.recv_fds(self._control, NAME_BYTES, 2)
        if not packet:
            self._poll.unregister(self._control)
            self._gone_s = monotonic_s()
            return
        if not descriptors:
            self._prepare(packet.decode())
            return
        answers, descriptor = descriptors
        self._start(socket.socket(fileno=answers), packet.decode(), descriptor)
        os.close(descriptor)

    def _prepare(self, name: str) -> None:
        own, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            try:
                pid = os.fork()
            except OSError:  # which is told of when the stage is to start
                own.close()
                return
            if pid == 0:
                own.close()
                self._become(theirs, name, None)
        self._prepared[name] = pid, own

    def _start(self, answers: socket.socket, name: str, descriptor: int) -> None:
        pid = self._handed_over(name, descriptor)
        try:
            pid = pid or os.fork()
        except OSError as error:  # no memory, or too many processes: the daemon tries again
            print(f"companion: no process for {name}: {error}", file=sys.stderr)
            answers.close()
            return
        if pid == 0:
            self._become(answers, name, descriptor)
        handle = os.pidfd_open(pid)
        self._children[handle] = pid, answers
        self._poll.register(handle, select.POLLIN)
        if not _send(answers, pid, [handle]):
            os.kill(pid, SIGKILL)  # nobody waits for it any more

    def _handed_over(self, name: str, descriptor: int) -> int | None:
        """Id of the process that was prepared for a stage and now has its socket; None without."""
        if name not in self._prepared:
            return None
        pid, to = self._prepared.pop(name)
        with to:
            try:
                socket.send_fds(to, [b"start"], [descriptor])
            except OSError:  # it has died, whyever
                os.waitpid(pid, 0)
                return None
        return pid

    def _become(self, asked: socket.socket, name: str, descriptor: int | None) -> NoReturn:
        """Be a stage from here on: nothing of the server's stays open.

        Without a descriptor wait for that, with all imported; `asked` is where it comes.
        """
        status = 1
        try:
            for _, other in self._prepared.values():
                other.close()
            for handle, (_, other) in self._children.items():
                os.close(handle)
                other.close()
            self._control.close()
            if descriptor is None:
                imported(name)
                _packet, given, _flags, _address = socket.recv_fds(asked, NAME_BYTES, 1)
                if not given:  # the daemon has no use for it
                    os._exit(0)
                (descriptor,) = given
            asked.close()
            status = run(name, descriptor)
        except BaseException:
            sys.excepthook(*sys.exc_info())
        finally:
            sys.stderr.flush()
            os._exit(status)

    def _tell_end(self, handle: int) -> None:
        pid, answers = self._children.pop(handle)
        self._poll.unregister(handle)
        _, status = os.waitpid(pid, 0)
        os.close(handle)
        _send(answers, os.waitstatus_to_exitcode(status), [])
        answers.close()


def _send(answers: socket.socket, number: int, descriptors: list[int]) -> bool:
    """Tell the daemon; False where it is gone, or has given the child up."""
    try:
        socket.send_fds(answers, [ANSWER.pack(number)], descriptors)
    except OSError:
        return False
    return True


def serve(control: socket.socket) -> NoReturn:
    """Be the server at the other end of a socket, until the daemon and all stages are gone."""
    status = 1
    try:
        Path("/proc/self/comm").write_text("fork server", "utf-8")
        ignore_signals()
        allow_descriptors()
        gc.freeze()
        _Server(control).run()
        status = 0
    except Exception:
        sys.excepthook(*sys.exc_info())
    finally:
        sys.stderr.flush()
        os._exit(status)


if __name__ == "__main__":
    serve(socket.socket(fileno=int(sys.argv[1])))
