"""STATUSTEXT: what the pilot reads at the ground station, in chunks where it is long."""

from __future__ import annotations

from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

CHUNK = 50
MOST_BYTES = 254
LAST_NUMBER = 65535


class StatusTexts:
    """Cuts texts into messages and numbers those of several."""

    def __init__(self) -> None:
        self._number = 0

    def messages(self, severity: int, text: str) -> list[Any]:
        """The messages that say it; what is too long for any ground station is cut off."""
        data = text.encode("ascii", "replace")[:MOST_BYTES]
        chunks = [data[at : at + CHUNK] for at in range(0, len(data), CHUNK)] or [b""]
        if len(chunks) == 1:
            return [mavlink.MAVLink_statustext_message(severity, data)]
        if len(chunks[-1]) == CHUNK:
            chunks.append(b"")  # only a chunk with room left ends a text
        self._number = self._number % LAST_NUMBER + 1
        return [
            mavlink.MAVLink_statustext_message(severity, chunk, self._number, place)
            for place, chunk in enumerate(chunks)
        ]
