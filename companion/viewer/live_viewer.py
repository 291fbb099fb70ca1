"""A viewer that is looked at now, in a process of its own.

A call into Rerun whose peer hangs does not return, cannot be cancelled from its own process, and
keeps that process from ending. A child process can be ended, so it is the child that calls.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import threading
from types import TracebackType

from companion.camera import Camera
from companion.config import ViewerConfig
from companion.errors import InputError
from companion.messages import Message
from companion.viewer.inbox import Inbox

ROOM_BYTES = 64 << 20
PATIENCE_S = 3.0
READY = b"ready\n"
CHILD = "companion.viewer.live_process"


class LiveViewer:
    """A viewer at `web`, `native`, or the rerun+http address of one that runs.

    It never makes the caller wait: what there is no room for is given up and counted. Raises
    InputError where no viewer can be reached or started.
    """

    def __init__(self, config: ViewerConfig, camera: Camera, where: str) -> None:
        self.n_dropped = 0
        self._inbox = Inbox(ROOM_BYTES)
        # a session of its own: Ctrl-C is for the run, and the whole of it can be ended at once
        self._child = subprocess.Popen(
            [sys.executable, "-m", CHILD],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            start_new_session=True,
        )  # fmt: skip
        self._thread = threading.Thread(target=self._work, name="viewer", daemon=True)
        try:
            self._send((config, camera, where))
            answer = self._answer()
        except BaseException:
            self._end_child()
            raise
        if answer != READY:
            self._end_child()
            said = answer.decode(errors="replace").strip() or "its process ended"
            raise InputError(f"--viewer {where}: {said}")

    def take(self, message: Message) -> None:
        """Queue one message, or drop it."""
        if not self._inbox.offer(message):
            self.n_dropped += 1

    @property
    def alive(self) -> bool:
        """Whether its process is there to be shown anything."""
        return self._child.poll() is None

    def start(self) -> None:
        """Begin to show what is queued."""
        self._thread.start()

    def __enter__(self) -> LiveViewer:
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close(PATIENCE_S)

    def close(self, patience_s: float) -> None:
        """Show what is queued, and end; each in the time given."""
        self._inbox.close()
        self._thread.join(patience_s)
        try:
            if not self._thread.is_alive():
                self._child.wait(patience_s)
        except subprocess.TimeoutExpired:
            pass  # it hangs, and is ended below
        finally:
            self._end_child()
        self._thread.join(patience_s)
        self.n_dropped += len(self._inbox)

    def _answer(self) -> bytes:
        assert self._child.stdout is not None
        return self._child.stdout.readline()

    def _send(self, thing: object) -> None:
        assert self._child.stdin is not None
        pickle.dump(thing, self._child.stdin, protocol=pickle.HIGHEST_PROTOCOL)
        self._child.stdin.flush()

    def _work(self) -> None:
        try:
            while (message := self._inbox.get()) is not None:
                self._send(message)
        except OSError:  # the viewer is gone; the flight goes on, and what follows is counted
            self.n_dropped += 1
            self._inbox.close()
        finally:
            self._close(self._child.stdin)

    def _end_child(self) -> None:
        """End the child and what it started; nothing where it has ended by itself."""
        if self._child.poll() is None:
            os.killpg(self._child.pid, signal.SIGKILL)
            self._child.wait()
        if not self._thread.is_alive():
            self._close(self._child.stdin)
        self._close(self._child.stdout)

    @staticmethod
    def _close(pipe: object) -> None:
        try:
            pipe.close()  # type: ignore[attr-defined]
        except OSError:
            pass  # what was buffered for a child that is gone
