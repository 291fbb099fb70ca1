"""The daemon's own entries in the recording: bytes of the link, and health once a second."""

from __future__ import annotations

import asyncio
import dataclasses
from collections import deque
from typing import Any

from companion.daemon.flights.flights import Flights
from companion.daemon.health_watch import HealthWatch
from companion.flight_notes import HealthNote, LinkBytes
from companion.timing.clock import FlightClock
from drivers.mavlink.autopilot_link import AutopilotLink

EVERY_S = 1.0
LEAD_NS = 10_000_000_000
"""A recording begins with the link bytes of this long before the flight."""
MOST_IN_LEAD = 10_000
"""Reads from the link; more than the fastest link gives in that time."""


class RecorderNotes:
    """Records link bytes and health. To be used in the event loop."""

    def __init__(
        self, clock: FlightClock, flights: Flights, watch: HealthWatch, link: AutopilotLink | None
    ) -> None:
        self._clock, self._flights, self._watch, self._link = clock, flights, watch, link
        self._lead: deque[LinkBytes] = deque(maxlen=MOST_IN_LEAD)
        if link is not None:
            link.port.set_tap(self._on_bytes)

    async def run(self) -> None:
        """Record health once a second, until cancelled."""
        while True:
            await asyncio.sleep(EVERY_S)
            self._flights.take(HealthNote(self._clock.now_ns(), self._document()))

    def _on_bytes(self, outgoing: bool, data: bytes, monotonic_ns: int) -> None:
        taken = LinkBytes(
            self._clock.from_monotonic_ns(monotonic_ns), monotonic_ns, outgoing, bytes(data)
        )
        self._lead.append(taken)
        while taken.t_ns - self._lead[0].t_ns > LEAD_NS:
            self._lead.popleft()
        if self._flights.current is not None:
            while self._lead:
                self._flights.take(self._lead.popleft())

    def _document(self) -> dict[str, Any]:
        document: dict[str, Any] = {"health": self._watch.document()}
        link = self._link
        clock = link.clock_filter.report() if link is not None else None
        origin = link.origin if link is not None else None
        document["clock"] = dataclasses.asdict(clock) if clock is not None else None
        document["origin"] = dataclasses.asdict(origin) if origin is not None else None
        return document
