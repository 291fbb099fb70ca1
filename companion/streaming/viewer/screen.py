"""Screens: a window, a page in a browser, or a running viewer."""

from __future__ import annotations

import importlib.util
import os
import socket
import subprocess
import threading
from pathlib import Path
from urllib.parse import urlsplit

from companion.errors import InputError
from companion.streaming.viewer.web_proxy import LOOPBACK, WebProxy, free_ports
from companion.timing.clock import monotonic_s, wait_s

WEB_PORT = 9090
GRPC_PORT = 9876
START_S = 20.0
MEMORY = "50%"
"""Share of the ground's memory; the oldest poses and pictures are dropped first, the map stays."""


SERVER_MEMORY = "256MB"
"""Buffer for browsers that join late; the static map stays."""
DISPLAYS = "WAYLAND_DISPLAY", "WAYLAND_SOCKET", "DISPLAY"
WANTS = "a window wants one, a page for a browser (web) does not"
ENDED = f"the viewer has ended (status {{}}): is there a display? {WANTS}"


class Screen:
    """A viewer that listens at `address`, and its process where we have started it.

    `where` is web, native, or a rerun+http address; `bind` is the address of the two web ports.
    Raises InputError where there is no such viewer.
    """

    def __init__(self, where: str, bind: str = LOOPBACK) -> None:
        self.address = f"rerun+http://{LOOPBACK}:{GRPC_PORT}/proxy"
        self.process: subprocess.Popen[bytes] | None = None
        self.is_ours = False
        """True if the viewer ends with the flight: a page does, a window stays."""
        self.page = ""
        """Address for a browser."""
        self.proxy: WebProxy | None = None
        """Proxy for browsers; None without any."""
        if where == "web":
            self._serve(bind)
        elif where == "native":
            if not listens(LOOPBACK, GRPC_PORT):
                if not any(map(os.environ.get, DISPLAYS)):
                    raise InputError(f"there is no display; {WANTS}")
                self.process = _start(GRPC_PORT, detached=True)
        else:
            parts = urlsplit(where.removeprefix("rerun+"))
            if parts.hostname is None or not listens(parts.hostname, parts.port or GRPC_PORT):
                raise InputError(
                    "no viewer listens there; start one with `rerun`, or correct the address"
                )
            self.address = where

    def _serve(self, bind: str) -> None:
        for port in (GRPC_PORT, WEB_PORT):
            if listens(LOOPBACK, port):
                raise InputError(
                    f"port {port} is taken; end what listens there, or give its address"
                )
        inner_grpc, inner_web = free_ports(2)
        self.process = _start(
            inner_grpc, "--serve-web", "--web-viewer-port", str(inner_web),
            "--newest-first", "--cors-allow-origin", f"http://*:{WEB_PORT}",
        )  # fmt: skip
        self.is_ours = True
        self.address = f"rerun+http://{LOOPBACK}:{inner_grpc}/proxy"
        listeners = {(bind, GRPC_PORT): inner_grpc, (bind, WEB_PORT): inner_web}
        try:
            self.proxy = WebProxy(listeners, watched=GRPC_PORT)
        except OSError as error:
            self.process.kill()
            self.process.wait()
            raise InputError(f"{bind}: no page can be served there: {error.strerror}") from error
        self.page = page_of(LOOPBACK if bind in ("0.0.0.0", "::") else bind)

    @property
    def is_gone(self) -> bool:
        """True once a viewer that was started here has ended."""
        return self.process is not None and self.process.poll() is not None

    @property
    def fault(self) -> str:
        """Words for a viewer that was started here and ended by a fault of its own; else ""."""
        status = self.process.poll() if self.process is not None else None
        return ENDED.format(status) if status is not None and status > 0 else ""

    def close(self) -> None:
        """End what was started for this flight."""
        if self.proxy is not None:
            self.proxy.close()
        if self.process is not None and self.is_ours:
            self.process.terminate()
            self.process.wait()


def page_of(host: str) -> str:
    """Address, for a browser, of the page that shows this server."""
    shown = f"rerun%2Bhttp://{host}:{GRPC_PORT}/proxy"
    return f"http://{host}:{WEB_PORT}/?url={shown}&theme=dark"


def listens(host: str, port: int) -> bool:
    """True if a server accepts connections at an address."""
    try:
        with socket.create_connection((host, port), timeout=3.0):
            return True
    except OSError:
        return False


def _start(port: int, *arguments: str, detached: bool = False) -> subprocess.Popen[bytes]:
    command = [
        str(_executable()), "--bind", LOOPBACK, "--port", str(port), "--memory-limit", MEMORY,
        "--server-memory-limit", SERVER_MEMORY, *arguments,
    ]  # fmt: skip
    process = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL, start_new_session=detached,
    )  # fmt: skip
    until_s, never = monotonic_s() + START_S, threading.Event()
    while not listens(LOOPBACK, port):
        if process.poll() is not None:
            raise InputError(ENDED.format(process.returncode))
        if monotonic_s() > until_s:
            process.kill()
            raise InputError(f"the viewer did not start within {START_S:.0f} s")
        wait_s(never, 0.1)
    return process


def _executable() -> Path:
    """Viewer shipped with the library, whatever PATH says."""
    spec = importlib.util.find_spec("rerun_cli")
    for folder in (spec.submodule_search_locations or ()) if spec is not None else ():
        program = Path(folder) / "rerun"
        if program.exists():
            return program
    raise InputError("the viewer's program is not installed; pip install rerun-sdk brings it")
