"""Samples on their way to the stages: many in one message, in order with all others."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass

from companion.telemetry import Telemetry
from companion.timing.clock import monotonic_s

HELD_S = 0.02
"""Samples gather for this long, or until another message but bytes of the link: localisation takes
them with its next frame only, which never waits for more than a few of them to be opened."""
MOST_HELD = 64


@dataclass(frozen=True, slots=True)
class Samples:
    """Samples in the order that they came; a stage takes one after the other."""

    t_ns: int
    parts: tuple[Telemetry, ...]


class GatheredSamples:
    """Holds samples until `let_go`, which `pass_on` gets; both may be called from any thread.

    Many are pickled, passed on and opened together in little more time than one.
    """

    def __init__(self, pass_on: Callable[[list[Telemetry]], None]) -> None:
        self._pass_on = pass_on
        self._held: list[Telemetry] = []
        self._since_s = 0.0
        self._lock = threading.Lock()
        """Held while they are passed on: none overtakes those before."""

    def put(self, sample: Telemetry) -> None:
        """Take a sample; with it go those that have waited for long."""
        now_s = monotonic_s()
        with self._lock:
            if not self._held:
                self._since_s = now_s
            self._held.append(sample)
            if now_s - self._since_s >= HELD_S or len(self._held) >= MOST_HELD:
                self._let_go()

    def let_go(self) -> None:
        """Pass on what is held: another message is to come after it."""
        with self._lock:
            self._let_go()

    def _let_go(self) -> None:
        if self._held:
            held, self._held = self._held, []
            self._pass_on(held)
