"""Warnings about the autopilot's wire and the router's clients that no message reports."""

from __future__ import annotations

from collections.abc import Callable

from companion.messages import Warned
from drivers.mavlink.wire.message_port import MavlinkPort
from drivers.mavlink.wire.router import ClientCounts

LOOK_NS = 1_000_000_000
WARN_AGAIN_NS = 10_000_000_000
FEW = 3
"""Errors per second that are ignored: a port just opened begins within a packet."""

DAMAGED = "damaged data on the autopilot's link"
REFUSED = "a client of the router is refused"
FLOODS = "a client of the router sends more than the link takes"
SLOW = "a client of the router is too slow"
NO_MAVLINK = "a client of the router sends damaged data"


class LinkWatch:
    """Checks a port's counters once a second, and warns of those that rise."""

    def __init__(self, port: MavlinkPort, warn: Callable[[Warned], None]) -> None:
        self._port, self._warn = port, warn
        self._looked_ns = 0
        self._n_bad = 0
        self._clients: dict[str, ClientCounts] = {}
        self._warned_ns: dict[tuple[str, str], int] = {}

    def step(self, now_ns: int) -> None:
        """Check the counters, if it is time."""
        if now_ns - self._looked_ns < LOOK_NS:
            return
        self._looked_ns = now_ns
        n_bad, self._n_bad = self._n_bad, self._port.n_bad
        self._risen(DAMAGED, self._port.name, self._n_bad - n_bad, "times")
        before, self._clients = self._clients, {each.name: each for each in self._port.clients()}
        for name, now in self._clients.items():
            was = before.get(name, ClientCounts(name, True, 0, 0, 0, 0, 0))
            self._risen(REFUSED, name, now.n_refused - was.n_refused, "packets")
            self._risen(FLOODS, name, now.n_dropped_in - was.n_dropped_in, "packets given up")
            self._risen(NO_MAVLINK, name, now.n_bad_bytes - was.n_bad_bytes, "bytes")
            if now.connected:
                self._risen(SLOW, name, now.n_dropped_out - was.n_dropped_out, "packets given up")

    def _risen(self, what: str, name: str, n: int, of: str) -> None:
        last_ns = self._warned_ns.get((what, name))
        if n > FEW and (last_ns is None or self._looked_ns - last_ns >= WARN_AGAIN_NS):
            # names of clients that come and go have their port in them
            self._warned_ns = {
                key: t_ns for key, t_ns in self._warned_ns.items()
                if self._looked_ns - t_ns < WARN_AGAIN_NS
            }  # fmt: skip
            self._warned_ns[what, name] = self._looked_ns
            self._warn(Warned(self._looked_ns, what, f"{name}: {n} {of} in a second"))
