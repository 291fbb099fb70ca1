"""MAVLink 2 signatures: rejects packets without the key, and replayed packets."""

from __future__ import annotations

import hashlib
import hmac
from pathlib import Path

from companion.errors import ConfigError
from drivers.mavlink.wire.packet_stream import Packet

EPOCH_UNIX_NS = 1_420_070_400_000_000_000
"""Signatures count tens of microseconds since the beginning of 2015."""
UNIT_NS = 10_000
MOST_BEHIND = 60 * 1_000_000_000 // UNIT_NS
KEY_DIGITS = 64


def read_key(path: Path) -> bytes:
    """Key in a file of 64 hexadecimal digits; ConfigError if invalid."""
    try:
        text = path.read_text("ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is no text"
        raise ConfigError(f"link.signing_key_file: {path} cannot be read: {reason}") from error
    try:
        key = bytes.fromhex(text)
    except ValueError:
        key = b""
    if len(text) != KEY_DIGITS or len(key) != KEY_DIGITS // 2:
        raise ConfigError(
            f"link.signing_key_file: {path} must hold {KEY_DIGITS} hexadecimal digits and no more"
        )
    return key


class MavlinkSigning:
    """Timestamps for our signatures, and validation of others'.

    Timestamps follow the clock, or the newest of anybody with the key where that is ahead: so the
    autopilot corrects a computer without a battery clock.
    """

    def __init__(self, key: bytes) -> None:
        self.key = key
        self._newest = 0
        self._streams: dict[tuple[int, int, int], int] = {}

    def next_stamp(self, unix_ns: int) -> int:
        """Timestamp of the next packet: later than any before."""
        self._newest = max(self._newest + 1, (unix_ns - EPOCH_UNIX_NS) // UNIT_NS)
        return self._newest

    def accepts(self, packet: Packet, unix_ns: int) -> bool:
        """True if a packet is signed with the key, and newer than all of its stream before."""
        if not packet.signed:
            return False
        raw = packet.raw
        digest = hashlib.sha256(self.key + raw[:-6]).digest()
        if not hmac.compare_digest(digest[:6], raw[-6:]):
            return False
        stamp = int.from_bytes(raw[-12:-6], "little")
        stream = raw[-13], packet.system, packet.component
        last = self._streams.get(stream)
        if last is None:
            newest = max(self._newest, (unix_ns - EPOCH_UNIX_NS) // UNIT_NS)
            if stamp < newest - MOST_BEHIND:
                return False
        elif stamp <= last:
            return False
        self._streams[stream] = stamp
        self._newest = max(self._newest, stamp)
        return True
