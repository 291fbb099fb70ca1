"""sd_notify protocol (Type=notify): ready, watchdog, reloading, stopping.

Without $NOTIFY_SOCKET there is no service manager and nothing is sent. Sending never blocks and
never raises: a service manager that does not listen must not stop a flight.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Mapping

MAX_STATUS = 512


class ServiceManager:
    """The service manager that started this process, where there is one."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self.problem = ""
        """Reason why nothing can be sent although it should, in words."""
        self._address = ""
        self._socket: socket.socket | None = None
        address = environment.get("NOTIFY_SOCKET", "")
        if not address:
            return
        if address[0] not in "/@" or len(address) < 2:
            self.problem = f"$NOTIFY_SOCKET is {address}: only paths and @names are known"
            return
        # "@name" lies in the abstract namespace, whose names begin with a zero byte.
        self._address = "\0" + address[1:] if address[0] == "@" else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._socket.setblocking(False)

    @property
    def is_there(self) -> bool:
        """True where a service manager has started this process."""
        return self._socket is not None

    def ready(self, status: str = "") -> None:
        """READY=1; also at the end of a reload."""
        self._send("READY=1", _status(status))

    def status(self, text: str) -> None:
        """One line for `systemctl status`."""
        self._send(_status(text))

    def alive(self) -> None:
        """WATCHDOG=1; to be sent more often than WatchdogSec, only while the work goes on."""
        self._send("WATCHDOG=1")

    def reloading(self) -> None:
        """RELOADING=1; `ready` ends it."""
        self._send("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def stopping(self) -> None:
        """STOPPING=1."""
        self._send("STOPPING=1")

    def extend_timeout(self, seconds: float) -> None:
        """Extend the start or stop timeout by this much from now on."""
        self._send(f"EXTEND_TIMEOUT_USEC={round(seconds * 1e6)}")

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, *assignments: str) -> None:
        if self._socket is None:
            return
        notice = "\n".join(each for each in assignments if each).encode()
        try:
            self._socket.sendto(notice, self._address)
        except OSError as error:
            self.problem = f"the service manager cannot be told: {error.strerror}"


def _status(text: str) -> str:
    # A line break would begin another assignment.
    return "STATUS=" + " ".join(text.split())[:MAX_STATUS] if text else ""
