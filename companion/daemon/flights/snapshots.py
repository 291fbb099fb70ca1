"""Cloud snapshots in flight, and their progress for the ground station that asked."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from companion.daemon.flights.flights import Flights
from companion.daemon.flights.live_flight import LiveFlight
from companion.geometry.geodesy import GeoOrigin
from companion.pilot_messages import CLOUD_NOT_SAVED, CLOUD_SAVED, PilotText
from companion.runtime.stage_protocol import Snapshot
from drivers.mavlink.ground.command_server import ACCEPTED, FAILED, Job

RESULTS_GONE = "the results stage has died"


class Snapshots:
    """Cloud snapshots, one at a time. Used in the event loop.

    `tell` takes the pilot's text, the journal's text, and whether it is good news.
    """

    def __init__(self, flights: Flights, tell: Callable[[PilotText, str, bool], None]) -> None:
        self._flights, self._tell = flights, tell
        self._job: Job | None = None
        self._flight: LiveFlight | None = None
        self._number = self._n_restarted = 0

    def start(self, flight: LiveFlight, origin: GeoOrigin | None, job: Job) -> None:
        """Write a snapshot into the flight's folder."""
        self._number = self._number + 1 if flight is self._flight else 1
        self._flight, self._job = flight, job
        self._n_restarted = flight.n_restarted["results"]
        flight.take_snapshot(self._number, origin if flight.has_origin else None)

    def take(self, snapshot: Snapshot) -> None:
        """Take the progress that the results stage reports."""
        if self._job is None or snapshot.number != self._number:
            return
        self._job.percent = snapshot.percent
        if snapshot.path:
            path = Path(snapshot.path)
            self._tell(
                CLOUD_SAVED(n=str(snapshot.n_points)),
                f"cloud written: {path.name}, {snapshot.n_points} points", True,
            )  # fmt: skip
            self._job.result, self._job = ACCEPTED, None
        elif snapshot.why_not:
            self._fail(snapshot.why_not)

    def step(self) -> None:
        """Detect a snapshot that will not be finished; to be called often."""
        flight = self._flight
        if self._job is None or flight is None:
            return
        if self._job.result is not None:  # it took too long
            self._job = None
        elif (
            flight is not self._flights.current
            or flight.n_restarted["results"] != self._n_restarted
        ):
            self._fail(RESULTS_GONE)

    def _fail(self, why_not: str) -> None:
        assert self._job is not None
        self._tell(CLOUD_NOT_SAVED(), f"no cloud was written: {why_not}", False)
        self._job.result, self._job = FAILED, None
