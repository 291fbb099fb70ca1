"""TIMESYNC with the autopilot: what it is asked, what it answers, and its own questions.

TIMESYNC is that of https://mavlink.io/en/services/timesync.html with the target extension, which
pymavlink's dialect lacks. Receivers without the extension ignore it, and answer all requests.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.timing.clock import FlightClock
from companion.timing.link_clock import ClockFilter
from drivers.mavlink.commands import AUTOPILOT

_LAYOUT = struct.Struct("<qqBB")
_MAVLINK_2 = 0xFD
_PAYLOAD = 10
"""Offset of the payload in a MAVLink 2 packet."""
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
