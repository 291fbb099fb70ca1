"""Interface of a MAVLink port, whatever library and wire carry it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from drivers.mavlink.wire.router import ClientCounts
from drivers.mavlink.wire.wire import Tap

OnMessage = Callable[[Any, int], None]
"""Takes a pymavlink message, and its arrival on the flight's clock, ns."""


class MavlinkPort(Protocol):
    """One end of a MAVLink link. Used from one event loop; nothing here blocks or raises."""

    name: str
    """Endpoint, for people."""
    identity: tuple[int, int]
    """System and component of sent messages; may be set at any time."""
    second_component: int
    """Another component of ours on the same system; 0 for none."""

    @property
    def connected(self) -> bool:
        """True while the wire is open; says nothing about an autopilot at its other end."""

    @property
    def capacity_bytes_per_s(self) -> float | None:
        """Capacity of a serial line each way; None of a network, whose is not known."""

    @property
    def trouble(self) -> str:
        """Problem of the wire, for people; "" without one."""
        return ""

    @property
    def n_bad(self) -> int:
        """Rejected input: damaged packets, or missing or wrong signatures."""

    def clients(self) -> list[ClientCounts]:
        """Counters of the router's clients; one that has left is listed once more."""

    def set_tap(self, tap: Tap | None) -> None:
        """Call back with all bytes read from and written to the wire, clients' bytes too."""

    async def run(self, on_message: OnMessage) -> None:
        """Receive until cancelled, reconnecting as needed."""

    def send(self, message: Any, as_second: bool = False) -> None:
        """Send an unpacked pymavlink message; dropped and counted where impossible."""
