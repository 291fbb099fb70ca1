"""STATUSTEXT: what the pilot reads at the ground station, in chunks where it is long."""

from __future__ import annotations

from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drivers.mavlink_queue import RateLimit

CHUNK = 50
MOST_BYTES = 254
LAST_NUMBER = 65535
TEXTS_PER_S, TEXTS_AT_ONCE = 1.0, 12
WARNINGS_ONLY = 4
"""The last so many of those at once are for warnings."""
MOST_KEPT_BACK = 100


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


class TextLimit:
    """How much a pilot is told: some texts at once, then one a second."""

    def __init__(self) -> None:
        self._limit = RateLimit(TEXTS_PER_S, TEXTS_AT_ONCE)
        self._kept_back: set[str] = set()

    def passed(self, severity: int, text: str, now_ns: int) -> str:
        """The text, with how many others were kept back before; "" if this one is."""
        self._limit.refill(now_ns)
        wanted = 1.0 if severity <= mavlink.MAV_SEVERITY_WARNING else 1.0 + WARNINGS_ONLY
        if self._limit.left < wanted:
            if len(self._kept_back) < MOST_KEPT_BACK:
                self._kept_back.add(text)
            return ""
        self._limit.take(1.0)
        n = len(self._kept_back - {text})
        self._kept_back.clear()
        return f"{text} ({n} others not told)" if n else text
