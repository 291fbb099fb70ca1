"""MAVSDK as a carrier of raw packets, unchanged in both directions.

Between a connection and its raw bytes MAVSDK passes packets on unchanged, whatever their message,
system or signature. It is a component of its own on the link; nobody speaks to it, since it keeps
packets for itself.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

import mavsdk

ITSELF = (254, 25)
"""System and component."""
MAVLINK_2 = 0xFD
HANDLED = True


class Carrier:
    """One connection, held by MAVSDK's threads.

    `start` and `end` may block; not for the event loop. `take` is called in MAVSDK's thread with
    each packet that comes.
    """

    def __init__(self, url: str, take: Callable[[bytes], None]) -> None:
        self._url = url
        self._take = take
        self._lock = threading.Lock()
        self._held: mavsdk.Mavsdk | None = None

    def start(self) -> None:
        """Open the connection; MavsdkError if that is impossible now."""
        with self._lock:
            complaints.listen()
            configuration = mavsdk.Configuration.create_manual(*ITSELF, False)
            self._held = held = mavsdk.Mavsdk(configuration)
            configuration.destroy()
            on = mavsdk.ForwardingOption.ON
            held.add_any_connection_with_handle_and_forwarding("raw://", on)
            held.subscribe_raw_bytes_to_be_sent(self._came)
            held.add_any_connection_with_handle_and_forwarding(self._url, on)

    def send(self, packet: bytes) -> None:
        """Give MAVSDK a whole packet; its queue has no bound."""
        if self._held is not None:
            self._held.pass_received_raw_bytes(packet)

    def end(self) -> None:
        """Close the connection. MAVSDK first processes its queue."""
        with self._lock:
            held, self._held = self._held, None
            if held is not None:
                held.destroy()

    def _came(self, packet: bytes) -> None:
        if packet[0] == MAVLINK_2 and tuple(packet[5:7]) == ITSELF:
            return  # what it says of its own goes out at every end
        self._take(packet)


class Complaints:
    """Newest warning of MAVSDK, whose log is one per process and would be printed."""

    def __init__(self) -> None:
        self.newest = ""
        self._listening = False

    def listen(self) -> None:
        """Clear the newest warning; from now on nothing is printed."""
        self.newest = ""
        if not self._listening:
            self._listening = True
            mavsdk.log_subscribe(self._hear)

    def _hear(self, level: mavsdk.LogLevel, text: str, *_: object) -> bool:
        if level >= mavsdk.LogLevel.WARN:
            self.newest = text
        return HANDLED


complaints = Complaints()
