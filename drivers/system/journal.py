"""Journal lines: on standard error, with a priority where systemd reads them."""

from __future__ import annotations

import os
import sys
import threading
from collections import Counter
from collections.abc import Mapping

from companion.messages import Warned

ERROR, WARNING, INFO = 3, 4, 6
MAX_SAME_IN_A_ROW = 5
EVERY = 100
"""Interval, in warnings, at which a repeated one is written."""


class Journal:
    """Writer of the journal; may be used from any thread."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._with_priority = "JOURNAL_STREAM" in environment
        self._lock = threading.Lock()
        self.n_warnings: Counter[str] = Counter()
        self.newest: dict[str, Warned] = {}
        """Newest warning of each kind, the newest kind last."""

    def say(self, text: str, priority: int = INFO) -> None:
        """Write one line."""
        prefix = f"<{priority}>" if self._with_priority else "companion: "
        line = " ".join(text.split())
        with self._lock:
            try:
                print(prefix + line, file=sys.stderr, flush=True)
            except OSError:
                pass  # nobody listens any more, which must not end a flight

    def warn(self, warning: Warned) -> bool:
        """Count a warning, and write it unless it comes too often; whether it was written."""
        with self._lock:
            self.n_warnings[warning.what] += 1
            n = self.n_warnings[warning.what]
            self.newest.pop(warning.what, None)
            self.newest[warning.what] = warning
        written = n <= MAX_SAME_IN_A_ROW or n % EVERY == 0
        if written:
            often = f" (for the {n}th time)" if n > MAX_SAME_IN_A_ROW else ""
            detail = f": {warning.detail}" if warning.detail else ""
            kind, priority = ("", INFO) if warning.good else ("warning: ", WARNING)
            self.say(f"{kind}{warning.what}{detail}{often}", priority)
        return written
