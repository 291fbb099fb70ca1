"""The daemon's own entries in the recording: bytes of the link, and health once a second."""

from __future__ import annotations

import dataclasses
from collections import deque
from typing import Any

from companion.daemon.flights.flights import Flights
from companion.daemon.health_watch import HealthWatch
from companion.flight_notes import HealthNote, LinkBytes
from companion.timing.clock import FlightClock
from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.system.ticks import tick

EVERY_S = 1.0
LEAD_NS = 10_000_000_000
"""A recording begins with the link bytes of this long before the flight."""
MOST_IN_LEAD = 10_000
MOST_LEAD_BYTES = 2_000_000
"""More than the fastest link gives in that time: a flood of reads, or of large ones, is cut."""


class RecorderNotes:
    """Records link bytes and health. To be used in the event loop."""

    def __init__(
        self, clock: FlightClock, flights: Flights, watch: HealthWatch, link: AutopilotLink | None
    ) -> None:
        self._clock, self._flights, self._watch, self._link = clock, flights, watch, link
        self._lead: deque[LinkBytes] = deque()
        self._lead_bytes = 0
        if link is not None:
            link.port.set_tap(self._on_bytes)

    async def run(self) -> None:
        """Record health once a second, until cancelled."""
        while True:
            await tick(EVERY_S)
            self._flights.take(HealthNote(self._clock.now_ns(), self._document()))

    def _on_bytes(self, outgoing: bool, data: bytes, monotonic_ns: int) -> None:
        taken = LinkBytes(
            self._clock.from_monotonic_ns(monotonic_ns), monotonic_ns, outgoing, bytes(data)
        )
        if self._flights.current is not None and not self._lead:
            self._flights.take(taken)
            return
        self._lead.append(taken)
        self._lead_bytes += len(taken.data)
        while (
            taken.t_ns - self._lead[0].t_ns > LEAD_NS
            or len(self._lead) > MOST_IN_LEAD
            or self._lead_bytes > MOST_LEAD_BYTES
        ):
            self._lead_bytes -= len(self._lead.popleft().data)
        if self._flights.current is not None:
            self._lead_bytes = 0
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
