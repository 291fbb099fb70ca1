"""The process of the fork server: python -m companion.runtime.fork_server_process SOCKET_FD.

A single thread, so that a copy of it is whole. What it imports all stages need; what one of them
only needs that one imports, once it is a process of its own. The stage of the pose comes first:
imports of others, two seconds of a processor, wait until it is ready.
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
from companion.runtime.stages import stage_named
from companion.timing.clock import monotonic_s

ORPHANS_S = 60.0
"""Time for stages to finish once the daemon is gone: a recording is completed. Then they are
ended, since one that hangs would stay for ever."""
HELD_S = 10.0
"""Longest wait of other stages for the pose's; a first start that compiles takes longer, and their
messages would no longer have room."""


class _Server:
    def __init__(self, control: socket.socket) -> None:
        self._control = control
        self._poll = select.poll()
        self._poll.register(control, select.POLLIN)
        self._children: dict[int, tuple[int, socket.socket]] = {}
        """By handle: process id, and where its status goes."""
        self._prepared: dict[str, tuple[int, socket.socket]] = {}
        """By stage: a process that has imported what it needs, and what its socket is sent by."""
        self._pose: int | None = None
        """Pipe that ends once the pose's stage is ready, or dead; None where none is starting."""
        self._pose_since_s = 0.0
        self._held: list[tuple[socket.socket, str, int]] = []
        """Stages to start then: where the status goes, name and descriptor."""
        self._gone_s: float | None = None
        """Time when the daemon went."""

    def run(self) -> None:
        """Serve until the daemon and all children are gone."""
        while self._gone_s is None or self._children:
            is_timed = self._gone_s is not None or self._pose is not None
            for descriptor, _ in self._poll.poll(1000 if is_timed else None):
                if descriptor in self._children:
                    self._tell_end(descriptor)
                elif descriptor == self._pose:
                    self._release()
                else:
                    self._hear()
            if self._pose is not None and monotonic_s() > self._pose_since_s + HELD_S:
                self._release()
            if self._gone_s is not None and monotonic_s() > self._gone_s + ORPHANS_S:
                for pid, _ in self._children.values():
                    os.kill(pid, SIGKILL)

    def _hear(self) -> None:
        packet, descriptors, _flags, _address = socket.recv_fds(self._control, NAME_BYTES, 2)
        if not packet:
            self._poll.unregister(self._control)
            self._gone_s = monotonic_s()
            return
        name = packet.decode()
        if not descriptors:
            self._prepare(name)
            return
        answers, descriptor = descriptors
        if self._pose is not None and not _is_of_pose(name):
            self._held.append((socket.socket(fileno=answers), name, descriptor))
        else:
            self._start(socket.socket(fileno=answers), name, descriptor)
            os.close(descriptor)

    def _begin_pose(self, name: str) -> int | None:
        """Hold other stages from here on; what the pose's is to close. None for another stage."""
        if not _is_of_pose(name) or self._pose is not None:
            return None
        self._pose, ready = os.pipe()
        self._pose_since_s = monotonic_s()
        self._poll.register(self._pose, 0)  # its end is always reported
        return ready

    def _release(self) -> None:
        """Start the stages that were held."""
        assert self._pose is not None
        self._poll.unregister(self._pose)
        os.close(self._pose)
        self._pose = None
        while self._held:  # of those that still wait, each child closes what it has a copy of
            answers, name, descriptor = self._held.pop(0)
            self._start(answers, name, descriptor)
            os.close(descriptor)

    def _prepare(self, name: str) -> None:
        own, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            try:
                pid = self._forked(theirs, name, None, own)
            except OSError:  # which is told of when the stage is to start
                own.close()
                return
        self._prepared[name] = pid, own

    def _forked(
        self, asked: socket.socket, name: str, descriptor: int | None,
        own: socket.socket | None = None,
    ) -> int:  # fmt: skip
        """Process id of a new stage, which closes the server's `own`; OSError for none."""
        ready = self._begin_pose(name)
        try:
            pid = os.fork()
            if pid == 0:
                if own is not None:
                    own.close()
                self._become(asked, name, descriptor, ready)
            return pid
        finally:
            if ready is not None:
                os.close(ready)

    def _start(self, answers: socket.socket, name: str, descriptor: int) -> None:
        pid = self._handed_over(name, descriptor)
        try:
            pid = pid or self._forked(answers, name, descriptor)
        except OSError as error:  # no memory, or too many processes: the daemon tries again
            print(f"companion: no process for {name}: {error}", file=sys.stderr)
            answers.close()
            return
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

    def _become(
        self, asked: socket.socket, name: str, descriptor: int | None, ready: int | None
    ) -> NoReturn:
        """Be a stage from here on: nothing of the server's stays open.

        Without a descriptor wait for that, with all imported; `asked` is where it comes. `ready` is
        closed once the stage is.
        """
        status = 1
        try:
            if self._pose is not None:
                os.close(self._pose)
            for answers, _, held in self._held:
                answers.close()
                os.close(held)
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
            status = run(name, descriptor, lambda: None if ready is None else os.close(ready))
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


def _is_of_pose(name: str) -> bool:
    return stage_named(name).nice == 0


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
