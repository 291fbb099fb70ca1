"""Identity of our component on request: versions, capabilities, rates.

PROTOCOL_VERSION and COMPONENT_INFORMATION_BASIC are not in pymavlink's dialect and are packed here,
by https://mavlink.io/en/messages/common.html.
"""

from __future__ import annotations

import platform
import struct
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion import __version__

PROTOCOL_VERSION, COMPONENT_INFORMATION_BASIC = 300, 396
CAPABILITIES = (
    mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST
)
MAVLINK_2, MAVLINK_1 = 200, 100
"""Versions of the protocol, times a hundred."""
OFFICIAL = 255
"""Lowest byte of a release's version."""
NOT_SENT, NOT_OURS = -1, 0
"""Intervals of MESSAGE_INTERVAL."""


class _Packed(mavlink.MAVLink_message):  # type: ignore[misc]
    """MAVLink 2 message that the dialect lacks."""

    def __init__(self, number: int, name: str, crc_extra: int, payload: bytes) -> None:
        super().__init__(number, name)
        self._number, self._crc_extra, self._fields = number, crc_extra, payload

    def pack(self, mav: Any, force_mavlink1: bool = False) -> bytes:
        """The packet; always of MAVLink 2, since MAVLink 1 has no such numbers."""
        return bytes(self._pack(mav, self._crc_extra, self._fields))


def autopilot_version() -> Any:
    """AUTOPILOT_VERSION, which every kind of component may send."""
    nothing = [0] * 8
    return mavlink.MAVLink_autopilot_version_message(
        CAPABILITIES, _version(), 0, 0, 0, nothing, nothing, nothing, 0, 0, 0
    )


def protocol_version() -> Any:
    """PROTOCOL_VERSION; without the hashes of specification and library."""
    payload = struct.pack("<HHH16x", MAVLINK_2, MAVLINK_1, MAVLINK_2)
    return _Packed(PROTOCOL_VERSION, "PROTOCOL_VERSION", 217, payload)


def component_information(boot_ms: int) -> Any:
    """COMPONENT_INFORMATION_BASIC: manufacturer and version."""
    texts = [
        (b"companion", 32), (b"companion", 32), (__version__.encode(), 24),
        (platform.machine().encode(), 24), (b"", 32),
    ]  # fmt: skip
    payload = struct.pack("<QII", CAPABILITIES, boot_ms & 0xFFFFFFFF, 0)
    payload += b"".join(text[: size - 1].ljust(size, b"\0") for text, size in texts)
    return _Packed(COMPONENT_INFORMATION_BASIC, "COMPONENT_INFORMATION_BASIC", 50, payload)


def message_interval(message_id: int, rate_hz: float | None) -> Any:
    """MESSAGE_INTERVAL of a message: None if not ours, a rate of 0 if not streamed."""
    interval_us = NOT_OURS
    if rate_hz is not None:
        interval_us = round(1e6 / rate_hz) if rate_hz > 0 else NOT_SENT
    return mavlink.MAVLink_message_interval_message(message_id & 0xFFFF, interval_us)


def _version() -> int:
    major, minor, patch = (int(part) for part in __version__.split(".")[:3])
    return major << 24 | minor << 16 | patch << 8 | OFFICIAL
