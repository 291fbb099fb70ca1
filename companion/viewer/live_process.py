"""The process of a live viewer: messages come in by its standard input, and go out by Rerun."""

from __future__ import annotations

import importlib.util
import os
import pickle
import socket
import subprocess
import sys
import threading
from pathlib import Path
from urllib.parse import urlsplit

import rerun as rr

from companion.clock import monotonic_s, wait_s
from companion.errors import InputError
from companion.viewer.layout import layout
from companion.viewer.live_viewer import READY
from companion.viewer.scene import APPLICATION, Scene

LOOPBACK = "127.0.0.1"
WEB_PORT = 9090
GRPC_PORT = 9876
START_S = 20.0
FLUSH_S = 2.0


def main() -> int:
    """Serve one flight; the exit status."""
    config, camera, where = pickle.load(sys.stdin.buffer)
    try:
        address, server = reach(where)
        recording = rr.RecordingStream(APPLICATION)
        recording.connect_grpc(address, default_blueprint=layout())
    except InputError as error:
        _say(str(error).encode() + b"\n")
        return 1
    _say(READY)
    scene = Scene(recording, config, camera)
    try:
        while True:
            scene.take(pickle.load(sys.stdin.buffer))
    except EOFError:  # the flight is over
        scene.close()
        recording.flush(timeout_sec=FLUSH_S)
    if server is not None:
        server.terminate()
    return 0


def reach(where: str) -> tuple[str, subprocess.Popen[bytes] | None]:
    """The address of a viewer that listens, and its process where that is to end with the flight.

    Raises InputError where there is none.
    """
    if where == "web":
        for port in (GRPC_PORT, WEB_PORT):
            if listens(LOOPBACK, port):
                raise InputError(
                    f"port {port} is taken; end what listens there, or give its address"
                )
        server = _start(
            ["--serve-web", "--bind", LOOPBACK, "--port", str(GRPC_PORT)]
            + ["--web-viewer-port", str(WEB_PORT)], detached=False,
        )  # fmt: skip
        return _local(), server
    if where == "native":
        if not listens(LOOPBACK, GRPC_PORT):
            # its window stays when the flight is over
            _start(["--bind", LOOPBACK, "--port", str(GRPC_PORT)], detached=True)
        return _local(), None
    parts = urlsplit(where.removeprefix("rerun+"))
    if parts.hostname is None or not listens(parts.hostname, parts.port or GRPC_PORT):
        raise InputError("no viewer listens there; start one with `rerun`, or correct the address")
    return where, None


def listens(host: str, port: int) -> bool:
    """Whether something accepts connections there."""
    try:
        with socket.create_connection((host, port), timeout=3.0):
            return True
    except OSError:
        return False


def _start(arguments: list[str], *, detached: bool) -> subprocess.Popen[bytes]:
    process = subprocess.Popen(
        [str(_executable()), *arguments], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL, start_new_session=detached,
    )  # fmt: skip
    until_s, never = monotonic_s() + START_S, threading.Event()
    while not listens(LOOPBACK, GRPC_PORT):
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


def _local() -> str:
    return f"rerun+http://{LOOPBACK}:{GRPC_PORT}/proxy"


def _say(line: bytes) -> None:
    sys.stdout.buffer.write(line)
    sys.stdout.buffer.flush()


if __name__ == "__main__":
    # not by the interpreter's end, where the library would wait for a peer that hangs
    os._exit(main())
