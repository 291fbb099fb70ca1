"""Date by the autopilot's SYSTEM_TIME, mostly from its GPS."""

from __future__ import annotations

from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drivers.mavlink.autopilot_link import AutopilotLink

N_ALIKE, ALIKE_NS = 3, 1_000_000_000
"""Number of consecutive messages that must agree: a single one may be damaged or late."""


class AutopilotDate:
    """Date of an autopilot against the flight's clock. Used in the event loop."""

    def __init__(self, link: AutopilotLink) -> None:
        self.ahead_ns: int | None = None
        """Correction of the flight's clock; None while the autopilot has no date."""
        self._n_alike, self._latest_ns = 0, 0
        link.listen(mavlink.MAVLINK_MSG_ID_SYSTEM_TIME, self._take)

    def _take(self, message: Any, receive_ns: int) -> None:
        if not message.time_unix_usec:
            self._n_alike = 0
            return
        ahead_ns = int(message.time_unix_usec) * 1000 - receive_ns
        alike = self._n_alike and abs(ahead_ns - self._latest_ns) < ALIKE_NS
        self._n_alike = self._n_alike + 1 if alike else 1
        self._latest_ns = ahead_ns
        if self._n_alike >= N_ALIKE:
            self.ahead_ns = ahead_ns
