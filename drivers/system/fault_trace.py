"""Tracebacks of drivers' bugs in the journal, once per place.

For loops that must continue whatever is wrong in what they call. Expected failures are handled
where they happen and never come here.
"""

from __future__ import annotations

import os
import sys
import threading
import traceback
from collections.abc import Mapping

PRIORITY = "<3>"
"""Prefix of lines for systemd: an error (sd-daemon(3))."""
MOST_PLACES = 64
"""Limit of places, so that a driver cannot fill the disk with tracebacks."""


class FaultTraces:
    """Writes tracebacks to standard error, which is the journal; may be used from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._seen_places: set[tuple[str, str, int]] = set()

    def tell(self, error: BaseException, secrets: Mapping[str, str] | None = None) -> bool:
        """Write the traceback, unless this exception came from here before; whether it was new.

        `secrets` is what may not be printed, and what to print instead.
        """
        place = _place_of(error)
        with self._lock:
            if place in self._seen_places or len(self._seen_places) >= MOST_PLACES:
                return False
            self._seen_places.add(place)
        text = "".join(traceback.format_exception(error))
        for secret, instead in (secrets or {}).items():
            text = text.replace(secret, instead) if secret else text
        prefix = PRIORITY if "JOURNAL_STREAM" in os.environ else "companion: "
        try:
            print("\n".join(prefix + line for line in text.splitlines()), file=sys.stderr)
        except OSError:
            pass  # nobody listens any more, which must not end a flight
        return True


def _place_of(error: BaseException) -> tuple[str, str, int]:
    frames = traceback.extract_tb(error.__traceback__)
    last = frames[-1] if frames else None
    return type(error).__name__, last.filename if last else "", (last.lineno or 0) if last else 0
