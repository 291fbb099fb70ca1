"""MAVSDK as a carrier of raw packets, unchanged in both directions.

Between a connection and its raw bytes MAVSDK passes packets on unchanged, whatever their message,
system or signature. It gets an identity of its own that nobody speaks to, since it keeps packets
for itself; and its own messages (heartbeats, requests for versions) are suppressed, so that one
component is on the link: ours.
"""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable
from typing import Any

import mavsdk
from mavsdk import logging as mavsdk_logging
from mavsdk import types as mavsdk_types
from mavsdk.cmavsdk_loader import _cmavsdk_lib as library

from companion.errors import ConfigError

NOBODY = (254, 25)
"""System and component."""
DROP = 0
HANDLED = True
WARNING = 2


def check_library() -> None:
    """ConfigError unless this MAVSDK can be kept silent, by a function of its C interface."""
    try:
        intercept = library.mavsdk_subscribe_outgoing_messages_json
    except AttributeError:
        raise ConfigError(
            f"mavsdk {mavsdk.__version__} cannot be kept from sending heartbeats of its own; set "
            'expert.link.backend = "pymavlink"'
        ) from None
    intercept.argtypes = [ctypes.c_void_p, mavsdk_types.InterceptJsonCallback, ctypes.c_void_p]
    intercept.restype = ctypes.c_void_p


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
        self._silencer: Any = None

    def start(self) -> None:
        """Open the connection; MavsdkError if that is impossible now."""
        with self._lock:
            complaints.listen()
            configuration = mavsdk.Configuration.create_manual(*NOBODY, False)
            self._held = held = mavsdk.Mavsdk(configuration)
            configuration.destroy()
            # kept for as long as MAVSDK may call it
            self._silencer = mavsdk_types.InterceptJsonCallback(lambda message, data: DROP)
            library.mavsdk_subscribe_outgoing_messages_json(held._handle, self._silencer, None)
            on = mavsdk.ForwardingOption.ON
            held.add_any_connection_with_handle_and_forwarding("raw://", on)
            held.subscribe_raw_bytes_to_be_sent(self._take)
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
            self._silencer = None


class Complaints:
    """Newest warning of MAVSDK, whose log is one per process and would be printed."""

    def __init__(self) -> None:
        self.newest = ""
        self._callback: Any = None

    def listen(self) -> None:
        """Clear the newest warning; from now on nothing is printed."""
        self.newest = ""
        if self._callback is None:
            self._callback = mavsdk_logging.LogCallback(self._hear)
            library.mavsdk_log_subscribe(self._callback, None)

    def _hear(self, level: int, text: bytes | None, *_: Any) -> bool:
        if level >= WARNING:
            self.newest = (text or b"").decode("utf-8", "replace")
        return HANDLED


complaints = Complaints()
