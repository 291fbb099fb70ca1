"""Process of the page: serves it until its standard input ends, as the daemon does.

While the motors are armed it gets only the processor time that nobody else wants: a stage that
wakes up then takes the core at once, and not after the page's turn of some milliseconds.
"""

from __future__ import annotations

import asyncio
import os
import resource
import signal
import socket
import sys
import threading
from typing import Any

from companion.errors import CompanionError, ConfigError
from companion.page.application import application
from companion.page.bounded_server import bounded_server
from companion.page.daemon_watch import DaemonWatch
from companion.page.facts import Facts
from companion.page.scene import Scene
from companion.timing.clock import monotonic_s, wait_s
from drivers.system.low_priority import all_threads_idle, may_take_back

NICE = 15
"""Of a busy processor it gets a thirtieth of what a stage gets."""
MEMORY_BYTES = 512 << 20
"""Most memory of its own: it ends then, and is started again."""
MOST_FILES = 256
GIVE_WAY = b"give way\n"
"""Line of the daemon once the motors are armed; any other says that they no longer are."""
AGAIN_S = 2.0
MOST_UNREAD_BYTES = 32768
"""Of a connection, in the kernel: the longest form is 10 kB, and all else is no request."""
OUT_OF_MEMORY_FIRST = "800"
"""oom_score_adj(5): where memory is short, this ends before a stage does."""


def main() -> int:
    """Serve; the exit status."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the daemon
    os.nice(NICE)
    for limit, most in ((resource.RLIMIT_DATA, MEMORY_BYTES), (resource.RLIMIT_NOFILE, MOST_FILES)):
        beyond = resource.getrlimit(limit)[1]  # which heavy work may use, in processes of its own
        resource.setrlimit(limit, (most, beyond))
    try:
        with open("/proc/self/oom_score_adj", "w", encoding="ascii") as file:
            file.write(OUT_OF_MEMORY_FIRST)
    except OSError:
        pass  # it may not be raised here: a container
    line = sys.stdin.buffer.readline()
    if not line:
        return 0
    threading.Thread(target=_heed_daemon, name="lifeline", daemon=True).start()
    facts = Facts.of_line(line)
    try:
        asyncio.run(_serve(facts, _listener(facts.config.page.listen)))
    except CompanionError as error:
        _say(str(error))
        return 1
    return 0


async def _serve(facts: Facts, listener: socket.socket) -> None:
    loop = asyncio.get_running_loop()
    loop.set_exception_handler(_tell_fault)
    watch = DaemonWatch(facts.socket)
    scene = Scene(lambda: watch.viewers_port)
    server = bounded_server(application(facts, watch, scene, monotonic_s, _say))
    await server.serve(sockets=[listener])


def _listener(listen: str) -> socket.socket:
    """Socket at HOST:PORT; waits while another has it. ConfigError for what is no address."""
    host, _, port = listen.rpartition(":")
    host = host.strip("[]")
    if not port.isdecimal() or not host:
        raise ConfigError(f"page.listen: {listen}: wanted HOST:PORT, or nothing")
    said, never = "", threading.Event()
    while True:
        try:
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            listener = socket.create_server((host, int(port)), family=family, backlog=32)
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, MOST_UNREAD_BYTES)
            return listener
        except (OSError, OverflowError) as error:
            why = f"page.listen: {listen}: {getattr(error, 'strerror', None) or error}"
            if why != said:
                said = why
                _say(f"the page cannot be served, which is tried again: {why}")
            wait_s(never, AGAIN_S)


def _heed_daemon() -> None:
    """Give way while the motors are armed, as far as that can be undone; end with the daemon."""
    stdin, heeds = sys.stdin.fileno(), may_take_back()
    while words := os.read(stdin, 4096):  # unbuffered: the interpreter cannot end within a buffer
        if heeds:
            all_threads_idle(words.endswith(GIVE_WAY))
    os._exit(0)


def _tell_fault(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Say of a fault in one line: a peer may cause any number of them."""
    error = context.get("exception")
    if error is not None and not isinstance(error, OSError):
        _say(f"the page: {context.get('message')}: {type(error).__name__}")


def _say(text: str) -> None:
    print(f"companion: {text}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
