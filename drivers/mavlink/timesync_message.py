"""TIMESYNC with the target extension, which pymavlink's dialect lacks.

https://mavlink.io/en/services/timesync.html. Receivers without the extension ignore it, and answer
all requests.
"""

from __future__ import annotations

import struct
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

_LAYOUT = struct.Struct("<qqBB")
_MAVLINK_2 = 0xFD
_PAYLOAD = 10
"""Offset of the payload in a MAVLink 2 packet."""


class TimesyncMessage(mavlink.MAVLink_timesync_message):  # type: ignore[misc]
    """A request (`tc1` 0) or a response, in ns, to a system's component; 0, 0 for all."""

    def __init__(self, tc1: int, ts1: int, target: tuple[int, int]) -> None:
        super().__init__(tc1, ts1)
        self._target = target

    def pack(self, mav: Any, force_mavlink1: bool = False) -> bytes:
        """The packet, as MAVLink 2 unless forced."""
        if force_mavlink1:
            return bytes(super().pack(mav, force_mavlink1=True))
        payload = _LAYOUT.pack(self.tc1, self.ts1, *self._target)
        return bytes(self._pack(mav, self.crc_extra, payload))


def timesync_target(message: Any) -> tuple[int, int]:
    """Target system and component of a received TIMESYNC; 0, 0 for all or none stated."""
    packet = bytes(message.get_msgbuf())
    if not packet or packet[0] != _MAVLINK_2:
        return 0, 0
    payload = packet[_PAYLOAD : _PAYLOAD + packet[1]].ljust(_LAYOUT.size, b"\0")
    return payload[16], payload[17]
