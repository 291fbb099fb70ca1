"""RTSP server in a process of its own; no picture ever waits for it."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import subprocess
import threading
from pathlib import Path

CHILD = Path(__file__).with_name("rtsp_child.py")
SYSTEM_PYTHON = "/usr/bin/python3"
PATH = "/camera"
PIPE_BYTES = 1 << 20
F_SETPIPE_SZ = 1031
"""fcntl(2); Python has its name from 3.10 on, and not on every system."""
AGAIN_S = 3.0
INSTALL = "apt install gir1.2-gst-rtsp-server-1.0 gstreamer1.0-plugins-good"


class RtspServer:
    """Serves what `send` gives at rtsp://HOST:PORT/camera, and starts the server anew where needed.

    `listen` is HOST:PORT, port 0 for a free one.
    """

    def __init__(self, listen: str, path: str = PATH) -> None:
        self._host, _, self._asked_port = listen.rpartition(":")
        self._path = path
        self.port = 0
        """Port that it has; 0 before there is one."""
        self.is_watched = False
        self.problem = ""
        """Reason why nobody can watch; "" where one can."""
        self._left = bytearray()
        self._feeding = threading.Lock()
        """Held while pictures are written, which never waits: no server ends, or begins, then."""
        self._over = threading.Event()
        self._child: subprocess.Popen[bytes] | None = None
        self._thread = threading.Thread(target=self._run, name="rtsp", daemon=True)
        self._thread.start()

    def send(self, picture: bytes) -> bool:
        """Send a picture (H.264, annex B); False where it was left out, as nothing is taken."""
        with self._feeding:
            child = self._child
            if child is None or child.stdin is None:
                return False
            if self._left:
                self._write(child.stdin.fileno())
            if self._left:
                return False
            self._left += len(picture).to_bytes(4, "little") + picture
            self._write(child.stdin.fileno())
            return True

    def close(self) -> None:
        """End it."""
        self._over.set()
        child = self._child
        if child is not None:
            child.kill()
        self._thread.join()

    def _write(self, fd: int) -> None:
        try:
            del self._left[: os.write(fd, self._left)]
        except BlockingIOError:
            pass
        except OSError:  # it has ended: another begins with a whole picture
            self._left.clear()

    def _run(self) -> None:
        while not self._over.is_set():
            try:
                self._serve()
            except OSError as error:
                self.problem = f"{SYSTEM_PYTHON}: {error.strerror or error}"
            self.is_watched, self.port = False, 0
            self._over.wait(AGAIN_S)

    def _serve(self) -> None:
        host = self._host.strip("[]") or "127.0.0.1"
        child = subprocess.Popen(
            [SYSTEM_PYTHON, "-I", str(CHILD), host, self._asked_port, self._path],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        assert child.stdin is not None and child.stdout is not None
        try:
            os.set_blocking(child.stdin.fileno(), False)
            with contextlib.suppress(OSError):  # it may have less
                fcntl.fcntl(child.stdin.fileno(), F_SETPIPE_SZ, PIPE_BYTES)
            with self._feeding:
                self._left.clear()
                self._child = child
            if self._over.is_set():
                return
            for line in child.stdout:
                self._hear(line)
        finally:
            with self._feeding:
                self._child = None
            child.kill()
            child.wait()
            child.stdin.close()
            child.stdout.close()

    def _hear(self, line: bytes) -> None:
        try:
            told = json.loads(line)
        except ValueError:
            return  # a plugin printed it
        if "error" in told:
            self.problem = f"{told['error']}: {INSTALL}"
        if "port" in told:
            self.port, self.problem = int(told["port"]), ""
        if "watched" in told:
            self.is_watched = bool(told["watched"])
