"""A new map in flight: its stages start beside the current flight, which then ends."""

from __future__ import annotations

from collections.abc import Callable

from companion.daemon.flights.flights import Flights
from companion.timing.clock import monotonic_s
from drivers.mavlink.ground.command_server import ACCEPTED, FAILED, Job

USUAL_S, MOST_S = 5.0, 30.0
READY_PERCENT = 90


class NewMap:
    """Change to a new map. Used in the event loop; `prepare` and `begin` are of the next flight."""

    def __init__(
        self, flights: Flights, prepare: Callable[[], None], begin: Callable[[], None]
    ) -> None:
        self._flights, self._prepare, self._begin = flights, prepare, begin
        self._job: Job | None = None
        self._since_s = 0.0

    def start(self, job: Job) -> None:
        """Start the stages; the current flight continues meanwhile."""
        self._job, self._since_s = job, monotonic_s()
        self._prepare()

    def step(self) -> None:
        """Change over once they are up; to be called often."""
        job = self._job
        if job is None:
            return
        standby, waited_s = self._flights.standby, monotonic_s() - self._since_s
        if self._flights.current is None or standby is None:
            job.result, self._job = FAILED, None
        elif standby.stages["localisation"].progress is not None or waited_s > MOST_S:
            self._flights.end()
            self._begin()
            job.percent, job.result, self._job = 100, ACCEPTED, None
        else:
            job.percent = int(READY_PERCENT * min(1.0, waited_s / USUAL_S))
