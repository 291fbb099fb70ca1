"""Server of a store's items to viewers. In a process of its own; see stage `viewers`."""

from __future__ import annotations

import contextlib
import selectors
import socket
import threading
from collections import OrderedDict
from collections.abc import Sequence

from companion.errors import StreamError
from companion.streaming.connection import Connection
from companion.streaming.datagrams import Datagrams
from companion.streaming.item_store import ItemStore
from companion.streaming.items import Item
from companion.streaming.parts import Part
from companion.streaming.send_window import TokenBucket
from companion.streaming.session import Session
from companion.timing.clock import monotonic_s

TICK_S, IDLE_S = 0.005, 0.05
HELLO_WITHIN_S = 5.0
MOST_REMEMBERED = 8
"""Sessions kept of disconnected viewers; the oldest are forgotten."""
PIECES_AT_ONCE = 16


class Exporter:
    """A loop over sockets; `take` may be called from another thread, and waits for no viewer."""

    def __init__(self, store: ItemStore, most_viewers: int, budget_kbit_s: float) -> None:
        self._store, self._most = store, most_viewers
        self._budget = TokenBucket(budget_kbit_s)
        self._lock = threading.Lock()
        self._selector = selectors.DefaultSelector()
        self._datagrams: list[Datagrams] = []
        self._connections: list[Connection] = []
        self._given: dict[Connection, int] = {}
        self._sessions: OrderedDict[bytes, Session] = OrderedDict()
        self._wake, self._woken = socket.socketpair()
        self._wake.setblocking(False)
        self._woken.setblocking(False)
        self._selector.register(self._woken, selectors.EVENT_READ)
        self._stopping = threading.Event()
        self.n_refused = 0
        self._n_skipped_before = 0
        """Skipped items of forgotten sessions."""

    def take(self, item: Item, parts: Sequence[Part]) -> None:
        """Keep and send an item with its encoded parts."""
        with self._lock:
            self._store.put(item, parts)
        self._wake_up()

    def listen(self, listener: socket.socket) -> None:
        """Accept viewers at a socket; from any thread."""
        listener.setblocking(False)
        self._selector.register(listener, selectors.EVENT_READ)
        with contextlib.suppress(OSError):  # somebody has that port: poses go with all else
            datagrams = Datagrams(listener)
            self._datagrams.append(datagrams)
            self._selector.register(datagrams.socket, selectors.EVENT_READ)

    def set_budget(self, kbit_s: float) -> None:
        """Limit the rate of all viewers together; 0 for no limit. From any thread."""
        self._budget.set_rate(kbit_s)
        self._wake_up()

    def stop(self) -> None:
        """End `run`; from any thread."""
        self._stopping.set()
        self._wake_up()

    def is_drained(self, n_least: int = 0) -> bool:
        """True if all connected viewers, at least `n_least`, have received everything."""
        with self._lock:
            sessions = [c.session for c in self._connections]
            done = [session is not None and session.is_complete for session in sessions]
        return all(done) and len(done) >= n_least

    def report(self) -> dict[str, float]:
        """Number of viewers, their rate, and data that was skipped."""
        with self._lock:
            sessions = [c.session for c in self._connections if c.session is not None]
            skipped = sum(s.n_skipped.total() for s in self._sessions.values())
            return {
                "viewers": len(sessions),
                "kbit_s": sum(s.window.rate_bytes_s for s in sessions) / 125,
                "budget_kbit_s": self._budget.bytes_s / 125,
                "skipped": self._n_skipped_before + skipped + self._store.n_evicted.total(),
                "map_mib": self._store.points_bytes / 2**20,
            }

    def run(self) -> None:
        """Serve until `stop`."""
        try:
            while not self._stopping.is_set():
                busy = self._step()
                for key, _ in self._selector.select(TICK_S if busy else IDLE_S):
                    self._handle_event(key.fileobj)
        finally:
            for connection in list(self._connections):
                self._forget(connection)
            for datagrams in self._datagrams:
                datagrams.socket.close()
            self._selector.close()
            self._wake.close()
            self._woken.close()

    def _handle_event(self, fileobj: object) -> None:
        now_s = monotonic_s()
        if fileobj is self._woken:
            with contextlib.suppress(BlockingIOError):
                self._woken.recv(4096)
            return
        for datagrams in self._datagrams:
            if fileobj is datagrams.socket:
                connected = {c.viewer: c.peer for c in self._connections if c.viewer is not None}
                datagrams.receive(now_s, connected)
                return
        connection = next((c for c in self._connections if c.socket is fileobj), None)
        if connection is None:
            assert isinstance(fileobj, socket.socket)
            self._accept(fileobj, now_s)
            return
        try:
            with self._lock:
                if connection.read(now_s):
                    self._begin_session(connection)
        except BlockingIOError:
            pass
        except (OSError, StreamError):
            self._forget(connection)

    def _accept(self, listener: socket.socket, now_s: float) -> None:
        try:
            opened, address = listener.accept()
        except OSError:  # it is gone already
            return
        if len(self._connections) >= 2 * self._most:
            self.n_refused += 1
            opened.close()
            return
        connection = Connection(opened, str(address[0]), now_s)
        self._connections.append(connection)
        self._given[connection] = 0
        self._selector.register(opened, selectors.EVENT_READ)

    def _begin_session(self, connection: Connection) -> None:
        """Resume the session of a known viewer, and close its former connection."""
        assert connection.viewer is not None
        for other in list(self._connections):
            if other is not connection and other.viewer == connection.viewer:
                self._forget(other)
        if sum(c.session is not None for c in self._connections) >= self._most:
            self.n_refused += 1
            raise StreamError("too many viewers")
        session = self._sessions.pop(connection.viewer, None)
        if session is None:
            session = Session(self._store)
        self._sessions[connection.viewer] = session
        session.reconnected()
        session.is_connected = True
        connection.session = session
        idle = [v for v in self._sessions if all(c.viewer != v for c in self._connections)]
        for viewer in idle[: max(0, len(self._sessions) - MOST_REMEMBERED)]:
            gone = self._sessions.pop(viewer)
            self._n_skipped_before += gone.n_skipped.total()
            self._store.unsubscribe(gone)

    def _step(self) -> bool:
        """Send what can be sent; whether there may be more soon."""
        now_s = monotonic_s()
        n_viewers = sum(c.session is not None for c in self._connections)
        self._connections.append(self._connections.pop(0)) if self._connections else None
        for connection in list(self._connections):
            try:
                self._serve(connection, now_s, n_viewers)
            except BlockingIOError:
                pass
            except (OSError, StreamError):
                self._forget(connection)
        return n_viewers > 0

    def _serve(self, connection: Connection, now_s: float, n_viewers: int) -> None:
        if connection.session is None:
            if now_s - connection.since_s > HELLO_WITHIN_S:
                raise StreamError("it does not say who it is")
            return
        connection.session.limit_bytes_s = self._budget.bytes_s / n_viewers
        self._send_pose(connection.session, connection.viewer, now_s)
        for _ in range(PIECES_AT_ONCE):
            with self._lock:
                n = connection.send(now_s, self._budget.available_bytes(now_s))
            if not n:
                break
            self._given[connection] += n
            self._budget.charge(connection.wire_bytes(self._given[connection]))
        else:
            self._wake_up()
        self._budget.charge(connection.wire_bytes(self._given[connection]))

    def _send_pose(self, session: Session, viewer: bytes | None, now_s: float) -> None:
        """Send the newest pose by datagram, where that may get through."""
        datagrams = next((d for d in self._datagrams if viewer and d.has_peer(viewer)), None)
        session.datagrams_work = bool(datagrams and viewer and datagrams.get_through(viewer, now_s))
        if datagrams is None or viewer is None or not self._budget.available_bytes(now_s):
            return
        with self._lock:
            data = session.next_datagram(now_s)
        if data is not None:
            self._budget.charge(datagrams.send(viewer, data))

    def _forget(self, connection: Connection) -> None:
        if connection in self._connections:
            self._connections.remove(connection)
            if connection.session is not None:
                connection.session.is_connected = False
            self._given.pop(connection, None)
            with contextlib.suppress(KeyError):
                self._selector.unregister(connection.socket)
            connection.close()

    def _wake_up(self) -> None:
        with contextlib.suppress(OSError):  # already woken, or closed
            self._wake.send(b"\0")


def open_listener(address: str) -> socket.socket:
    """A socket that listens at HOST:PORT; OSError where that cannot be."""
    host, port = address.rsplit(":", 1)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host.strip("[]"), int(port)))
        listener.listen(8)
    except OSError:
        listener.close()
        raise
    return listener
