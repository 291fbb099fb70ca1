"""Where a flight is looked at: a window, a page in a browser, or a viewer that runs already."""

from __future__ import annotations

import importlib.util
import socket
import subprocess
import threading
from pathlib import Path
from urllib.parse import urlsplit

from companion.clock import monotonic_s, wait_s
from companion.errors import InputError

LOOPBACK = "127.0.0.1"
WEB_PORT = 9090
GRPC_PORT = 9876
START_S = 20.0
MEMORY = "50%"
"""Of the ground's memory; the oldest poses and pictures go first, the map stays."""


class Screen:
    """A viewer that listens at `address`, and its process where that is ours to end.

    `where` is web, native, or a rerun+http address; `bind` is where the web's two ports are
    opened. Raises InputError where there is no such viewer.
    """

    def __init__(self, where: str, bind: str = LOOPBACK) -> None:
        self.address = f"rerun+http://{LOOPBACK}:{GRPC_PORT}/proxy"
        self.process: subprocess.Popen[bytes] | None = None
        self.is_ours = False
        """Whether it ends with the flight: a page does, a window stays."""
        self.page = ""
        """What to open in a browser."""
        if where == "web":
            for port in (GRPC_PORT, WEB_PORT):
                if listens(LOOPBACK, port):
                    raise InputError(
                        f"port {port} is taken; end what listens there, or give its address"
                    )
            self.process = _start("--serve-web", "--bind", bind, "--web-viewer-port", str(WEB_PORT))
            self.is_ours = True
            host = LOOPBACK if bind in ("0.0.0.0", "::") else bind
            if host != LOOPBACK:
                self.address = f"rerun+http://{host}:{GRPC_PORT}/proxy"
            self.page = page_of(host)
        elif where == "native":
            if not listens(LOOPBACK, GRPC_PORT):
                self.process = _start("--bind", LOOPBACK, detached=True)
        else:
            parts = urlsplit(where.removeprefix("rerun+"))
            if parts.hostname is None or not listens(parts.hostname, parts.port or GRPC_PORT):
                raise InputError(
                    "no viewer listens there; start one with `rerun`, or correct the address"
                )
            self.address = where

    @property
    def is_gone(self) -> bool:
        """Whether a viewer that was started here has ended."""
        return self.process is not None and self.process.poll() is not None

    def close(self) -> None:
        """End what is to end with the flight."""
        if self.process is not None and self.is_ours:
            self.process.terminate()
            self.process.wait()


def page_of(host: str) -> str:
    """The address, for a browser, of a page that shows what is served there."""
    return f"http://{host}:{WEB_PORT}/?url=rerun%2Bhttp://{host}:{GRPC_PORT}/proxy"


def listens(host: str, port: int) -> bool:
    """Whether something accepts connections there."""
    try:
        with socket.create_connection((host, port), timeout=3.0):
            return True
    except OSError:
        return False


def _start(*arguments: str, detached: bool = False) -> subprocess.Popen[bytes]:
    command = [
        str(_executable()), "--port", str(GRPC_PORT), "--memory-limit", MEMORY,
        "--server-memory-limit", "25%", *arguments,
    ]  # fmt: skip
    process = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL, start_new_session=detached,
    )  # fmt: skip
    bind = arguments[arguments.index("--bind") + 1]
    host = LOOPBACK if bind in ("0.0.0.0", "::") else bind
    until_s, never = monotonic_s() + START_S, threading.Event()
    while not listens(host, GRPC_PORT):
        if process.poll() is not None:
            raise InputError(
                f"the viewer ended at once (status {process.returncode}); is there a display?"
            )
        if monotonic_s() > until_s:
            process.kill()
            raise InputError(f"the viewer did not start within {START_S:.0f} s")
        wait_s(never, 0.1)
    return process


def _executable() -> Path:
    """The viewer that came with the library, wherever the shell looks for programs."""
    spec = importlib.util.find_spec("rerun_cli")
    for folder in (spec.submodule_search_locations or ()) if spec is not None else ():
        program = Path(folder) / "rerun"
        if program.exists():
            return program
    raise InputError("the viewer's program is not installed; pip install rerun-sdk brings it")
