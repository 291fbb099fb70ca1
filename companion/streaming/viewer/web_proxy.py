"""Flow-controlled proxy between browsers and Rerun's server; detects browsers that lag.

Rerun's server sends all it is given, and buffers without limit what a thin link cannot carry.
Behind this proxy it is given no more than the browsers take: drawing waits for them.
"""

from __future__ import annotations

import contextlib
import errno
import select
import selectors
import socket
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field

from companion.timing.clock import monotonic_s, wait_s

CAPACITY_BYTES = 65536
NOT_SENT_BYTES = 16384
LAG_S = 0.3
"""A browser whose data has waited for this long lags."""
LONGEST_WAIT_S = 2.0
"""Longest wait for a browser that takes nothing at all."""
LOOK_S = 0.02
MOST_CONNECTIONS = 64
"""Far more than some browsers with a few connections each; others are closed at once."""
PAUSE_S = 0.5
"""Pause of a listener for which there was no descriptor."""
LOOPBACK = "127.0.0.1"
NO_ROOM = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)


@dataclass(eq=False)
class _Direction:
    """One direction of a connection."""

    source: socket.socket
    sink: socket.socket
    is_watched: bool
    held: bytearray = field(default_factory=bytearray)
    since_s: float | None = None
    """Time since when data waits; None while none does."""
    ended: bool = False


class WebProxy:
    """Forwards connections to `listeners`, (address, port) each, to a port of this machine.

    `watched` is the port on which lag counts. OSError where a port cannot be opened.
    """

    def __init__(self, listeners: Mapping[tuple[str, int], int], watched: int) -> None:
        self._selector = selectors.DefaultSelector()
        self._directions: dict[socket.socket, tuple[_Direction, _Direction]] = {}
        self._paused: dict[socket.socket, tuple[tuple[int, bool], float]] = {}
        """Listeners that accept nothing until a time, and what they are registered with."""
        self._stop = threading.Event()
        for (host, port), inner in listeners.items():
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            listener = socket.create_server((host, port), family=family)
            listener.setblocking(False)
            self._selector.register(listener, selectors.EVENT_READ, (inner, port == watched))
        self._thread = threading.Thread(target=self._work, name="web gate", daemon=True)
        self._thread.start()

    def wait_for_browsers(self, stop: threading.Event) -> None:
        """Wait until no browser lags, or one has for too long."""
        until_s = monotonic_s() + LONGEST_WAIT_S
        while self.is_lagging and monotonic_s() < until_s and not stop.is_set():
            wait_s(stop, LOOK_S)

    @property
    def is_lagging(self) -> bool:
        """True while a browser does not take its data."""
        now_s = monotonic_s()
        since = [
            direction.since_s for pair in list(self._directions.values()) for direction in pair
        ]
        return any(s is not None and now_s - s > LAG_S for s in since)

    def close(self) -> None:
        """Close the ports."""
        self._stop.set()
        self._thread.join()

    def _work(self) -> None:
        while not self._stop.is_set():
            self._resume()
            for key, events in self._selector.select(0.1):
                assert isinstance(key.fileobj, socket.socket)
                if isinstance(key.data, tuple):
                    self._open(key.fileobj, *key.data)
                elif key.fileobj in self._directions:
                    self._pass(key.fileobj, events)
        for opened in list(self._selector.get_map().values()):
            assert isinstance(opened.fileobj, socket.socket)
            opened.fileobj.close()
        for listener in self._paused:
            listener.close()
        self._selector.close()

    def _resume(self) -> None:
        for listener, (data, until_s) in list(self._paused.items()):
            if monotonic_s() > until_s:
                del self._paused[listener]
                self._selector.register(listener, selectors.EVENT_READ, data)

    def _open(self, listener: socket.socket, inner: int, is_watched: bool) -> None:
        try:
            browser, _ = listener.accept()
        except OSError as error:
            if error.errno in NO_ROOM:  # it still waits, and would be reported all the time
                self._selector.unregister(listener)
                self._paused[listener] = (inner, is_watched), monotonic_s() + PAUSE_S
            return  # else it is gone already
        if len(self._directions) >= 2 * MOST_CONNECTIONS:
            browser.close()
            return
        try:
            server = socket.create_connection((LOOPBACK, inner), timeout=1.0)
        except OSError:
            browser.close()
            return
        browser.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, NOT_SENT_BYTES)
        for each in (browser, server):
            each.setblocking(False)
            each.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        out, back = _Direction(server, browser, is_watched), _Direction(browser, server, False)
        for each in (browser, server):
            self._directions[each] = (out, back)
            self._selector.register(each, selectors.EVENT_READ)

    def _pass(self, ready: socket.socket, events: int) -> None:
        directions = self._directions[ready]
        try:
            for direction in directions:
                has_room = len(direction.held) < CAPACITY_BYTES
                if direction.source is ready and events & selectors.EVENT_READ and has_room:
                    data = direction.source.recv(CAPACITY_BYTES)
                    direction.ended |= not data
                    direction.held += data
                if direction.held and _has_room(direction.sink):
                    # else the kernel would take, and keep, far more than the network does
                    del direction.held[: direction.sink.send(direction.held)]
                if not direction.held:
                    direction.since_s = None
                elif direction.since_s is None and direction.is_watched:
                    direction.since_s = monotonic_s()
            if any(direction.ended and not direction.held for direction in directions):
                raise ConnectionResetError
            for each in (directions[0].source, directions[0].sink):
                self._watch(each, directions)
        except BlockingIOError:
            pass
        except OSError:
            for each in (directions[0].source, directions[0].sink):
                self._forget(each)
                del self._directions[each]
                each.close()

    def _watch(self, each: socket.socket, directions: tuple[_Direction, _Direction]) -> None:
        wanted = 0
        for direction in directions:
            if (
                direction.source is each
                and len(direction.held) < CAPACITY_BYTES
                and not direction.ended
            ):
                wanted |= selectors.EVENT_READ
            if direction.sink is each and direction.held:
                wanted |= selectors.EVENT_WRITE
        self._forget(each)
        if wanted:
            self._selector.register(each, wanted)

    def _forget(self, each: socket.socket) -> None:
        with contextlib.suppress(KeyError):
            self._selector.unregister(each)


def _has_room(sink: socket.socket) -> bool:
    """True if a socket takes something now; select(2) knows no descriptors above 1023."""
    waiting = select.poll()
    waiting.register(sink, select.POLLOUT)
    return bool(waiting.poll(0))


def free_ports(n: int) -> list[int]:
    """Ports of this machine that are free now."""
    with contextlib.ExitStack() as stack:
        found = [stack.enter_context(socket.socket()) for _ in range(n)]
        for each in found:
            each.bind((LOOPBACK, 0))
        return [each.getsockname()[1] for each in found]
