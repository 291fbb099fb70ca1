"""TIMESYNC with the autopilot: what it is asked, what it answers, and its own questions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from companion.timing.clock import FlightClock
from companion.timing.link_clock import ClockFilter
from drivers.mavlink.commands import AUTOPILOT
from drivers.mavlink.timesync_message import TimesyncMessage, timesync_target

MAX_ROUND_TRIP_NS = 2_000_000_000
MAX_QUESTIONS = 64
"""Requests without an answer that are remembered."""


class ClockExchange:
    """Feeds the clock filter; `identity` gives system and component that we are."""

    def __init__(
        self, clock: FlightClock, clock_filter: ClockFilter, send: Callable[[Any], None],
        identity: Callable[[], tuple[int, int]],
    ) -> None:  # fmt: skip
        self._clock, self._filter, self._send = clock, clock_filter, send
        self._identity = identity
        self._questions: dict[int, None] = {}

    def ask(self, system: int) -> None:
        """Ask the autopilot of a system for its time."""
        while len(self._questions) >= MAX_QUESTIONS:
            del self._questions[next(iter(self._questions))]
        now_ns = self._clock.now_ns()
        self._questions[now_ns] = None
        self._send(TimesyncMessage(0, now_ns, (system, AUTOPILOT)))

    def restart(self) -> None:
        """Forget what was asked: the autopilot has rebooted."""
        self._questions.clear()

    def take(self, message: Any, receive_ns: int) -> None:
        """Take a TIMESYNC of the autopilot: a question, or an answer to ours."""
        targets = zip(timesync_target(message), self._identity(), strict=True)
        if any(target not in (0, ours) for target, ours in targets):
            return
        if message.tc1 == 0:  # the autopilot asks, and states its own time in doing so
            middle_ns = receive_ns + (self._clock.now_ns() - receive_ns) // 2
            asker = message.get_srcSystem(), message.get_srcComponent()
            self._send(TimesyncMessage(middle_ns, message.ts1, asker))
            if message.ts1 > 0:
                self._filter.one_way(message.ts1, receive_ns)
        elif message.ts1 in self._questions:  # answers to others are none of ours
            del self._questions[message.ts1]
            if message.tc1 > 0 and 0 <= receive_ns - message.ts1 <= MAX_ROUND_TRIP_NS:
                self._filter.exchange(message.ts1, message.tc1, receive_ns)
