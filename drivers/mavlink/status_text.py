"""STATUSTEXT to the pilot, rate-limited.

The texts are in `companion.pilot_messages`; each fits into one message.
"""

from __future__ import annotations

from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.pilot_messages import LEFT_OUT, PilotText
from companion.timing.rate_limit import RateLimit

TEXTS_PER_S, TEXTS_AT_ONCE = 1.0, 12
WARNINGS_ONLY = 4
"""Part of the burst that is reserved for warnings."""
MOST_KEPT_BACK = 100


def status_text(text: PilotText) -> Any:
    """The message of a text."""
    return mavlink.MAVLink_statustext_message(text.severity, text.text.encode("ascii"))


class TextLimit:
    """Rate limit of texts: a burst at once, then one a second."""

    def __init__(self) -> None:
        self._limit = RateLimit(TEXTS_PER_S, TEXTS_AT_ONCE)
        self._kept_back: set[str] = set()

    def passed(self, text: PilotText, now_ns: int) -> list[PilotText]:
        """The text, and the number held back before; nothing if this one is held back."""
        self._limit.refill(now_ns)
        wanted = 1.0 if text.severity <= mavlink.MAV_SEVERITY_WARNING else 1.0 + WARNINGS_ONLY
        if self._limit.left < wanted:
            if len(self._kept_back) < MOST_KEPT_BACK:
                self._kept_back.add(text.text)
            return []
        self._limit.take(1.0)
        self._kept_back.discard(text.text)
        if not self._kept_back or self._limit.left < 1.0 + WARNINGS_ONLY:
            return [text]
        self._limit.take(1.0)
        n = len(self._kept_back)
        self._kept_back.clear()
        return [text, LEFT_OUT(n=str(n))]
