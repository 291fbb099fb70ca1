"""MAVLink messages in and out, whatever library and whatever wire carries them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from drivers.mavlink.wire.router import ClientCounts
from drivers.mavlink.wire.wire import Tap

OnMessage = Callable[[Any, int], None]
"""Takes a message as pymavlink has it, and the flight's time at which it came, ns."""


class MavlinkPort(Protocol):
    """One end of a MAVLink link. Used from one event loop; nothing here blocks or raises."""

    name: str
    """For people: what it is plugged into."""
    identity: tuple[int, int]
    """System and component that `send` speaks as; may be set at any time, by who knows it."""

    @property
    def connected(self) -> bool:
        """Whether the wire is there; it says nothing about an autopilot at its other end."""

    @property
    def trouble(self) -> str:
        """What is wrong with the wire, for people; "" when nothing is known to be."""
        return ""

    @property
    def n_received(self) -> int:
        """Good packets that came, those of unknown messages too."""

    @property
    def n_sent(self) -> int:
        """Messages handed to the wire."""

    @property
    def n_dropped(self) -> int:
        """Messages that could not be sent."""

    @property
    def n_bad(self) -> int:
        """Times that something came which was refused: damaged, or not signed as it should be."""

    def clients(self) -> list[ClientCounts]:
        """How those do who share the link; who has left is in it once more."""

    def set_tap(self, tap: Tap | None) -> None:
        """Have all bytes told to it, as they come from the wire and go on it; whoever sent them."""

    async def run(self, on_message: OnMessage) -> None:
        """Receive for ever, reconnecting as needed; ends when it is cancelled."""

    def send(self, message: Any) -> None:
        """Send a pymavlink message that has not been packed yet; dropped and counted if need be."""
