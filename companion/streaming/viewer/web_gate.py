"""The door through which browsers see a page and what is drawn on it; it knows when they lag.

Rerun's server sends all it is given, and keeps what a thin link has no room for. Behind this door
it gets no more than the browsers take: whoever draws waits while the door has to.
"""

from __future__ import annotations

import contextlib
import select
import selectors
import socket
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field

from companion.timing.clock import monotonic_s, wait_s

ROOM_BYTES = 65536
NOT_SENT_BYTES = 16384
BEHIND_S = 0.3
"""A browser for which something has waited for so long does not keep up."""
LONGEST_WAIT_S = 2.0
"""A browser that takes nothing at all holds the others up no longer than this at a time."""
LOOK_S = 0.02
LOOPBACK = "127.0.0.1"


@dataclass(eq=False)
class _Way:
    """One direction of a connection."""

    source: socket.socket
    sink: socket.socket
    is_watched: bool
    held: bytearray = field(default_factory=bytearray)
    since_s: float | None = None
    """Since when something has waited; None while nothing does."""
    ended: bool = False


class WebGate:
    """Connections to `doors`, (address, port) each, go on to a port of this machine.

    `watched` is the port of the doors at which lag counts. OSError where a door cannot be opened.
    """

    def __init__(self, doors: Mapping[tuple[str, int], int], watched: int) -> None:
        self._selector = selectors.DefaultSelector()
        self._ways: dict[socket.socket, tuple[_Way, _Way]] = {}
        self._stop = threading.Event()
        for (host, port), inner in doors.items():
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            door = socket.create_server((host, port), family=family)
            door.setblocking(False)
            self._selector.register(door, selectors.EVENT_READ, (inner, port == watched))
        self._thread = threading.Thread(target=self._work, name="web gate", daemon=True)
        self._thread.start()

    def wait_for_room(self, stop: threading.Event) -> None:
        """Wait until no browser lags, or has for too long."""
        until_s = monotonic_s() + LONGEST_WAIT_S
        while self.is_behind and monotonic_s() < until_s and not stop.is_set():
            wait_s(stop, LOOK_S)

    @property
    def is_behind(self) -> bool:
        """Whether a browser does not take what it is sent."""
        now_s = monotonic_s()
        since = [way.since_s for pair in list(self._ways.values()) for way in pair]
        return any(s is not None and now_s - s > BEHIND_S for s in since)

    def close(self) -> None:
        """Close the doors."""
        self._stop.set()
        self._thread.join()

    def _work(self) -> None:
        while not self._stop.is_set():
            for key, events in self._selector.select(0.1):
                assert isinstance(key.fileobj, socket.socket)
                if isinstance(key.data, tuple):
                    self._open(key.fileobj, *key.data)
                elif key.fileobj in self._ways:
                    self._pass(key.fileobj, events)
        for opened in list(self._selector.get_map().values()):
            assert isinstance(opened.fileobj, socket.socket)
            opened.fileobj.close()
        self._selector.close()

    def _open(self, door: socket.socket, inner: int, is_watched: bool) -> None:
        try:
            browser, _ = door.accept()
        except OSError:  # it is gone already
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
        out, back = _Way(server, browser, is_watched), _Way(browser, server, False)
        for each in (browser, server):
            self._ways[each] = (out, back)
            self._selector.register(each, selectors.EVENT_READ)

    def _pass(self, ready: socket.socket, events: int) -> None:
        ways = self._ways[ready]
        try:
            for way in ways:
                has_room = len(way.held) < ROOM_BYTES
                if way.source is ready and events & selectors.EVENT_READ and has_room:
                    data = way.source.recv(ROOM_BYTES)
                    way.ended |= not data
                    way.held += data
                if way.held and select.select([], [way.sink], [], 0)[1]:
                    # else the kernel would take, and keep, far more than the network does
                    del way.held[: way.sink.send(way.held)]
                if not way.held:
                    way.since_s = None
                elif way.since_s is None and way.is_watched:
                    way.since_s = monotonic_s()
            if any(way.ended and not way.held for way in ways):
                raise ConnectionResetError
            for each in (ways[0].source, ways[0].sink):
                self._watch(each, ways)
        except BlockingIOError:
            pass
        except OSError:
            for each in (ways[0].source, ways[0].sink):
                self._forget(each)
                del self._ways[each]
                each.close()

    def _watch(self, each: socket.socket, ways: tuple[_Way, _Way]) -> None:
        wanted = 0
        for way in ways:
            if way.source is each and len(way.held) < ROOM_BYTES and not way.ended:
                wanted |= selectors.EVENT_READ
            if way.sink is each and way.held:
                wanted |= selectors.EVENT_WRITE
        self._forget(each)
        if wanted:
            self._selector.register(each, wanted)

    def _forget(self, each: socket.socket) -> None:
        with contextlib.suppress(KeyError):
            self._selector.unregister(each)


def free_ports(n: int) -> list[int]:
    """Ports of this machine on which nobody listens now."""
    with contextlib.ExitStack() as stack:
        found = [stack.enter_context(socket.socket()) for _ in range(n)]
        for each in found:
            each.bind((LOOPBACK, 0))
        return [each.getsockname()[1] for each in found]
