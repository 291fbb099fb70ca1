"""Outputs of a flight's stages, passed on in the daemon to whom they concern."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from companion.daemon.control.ground_control import GroundControl
from companion.daemon.flight_starts import FlightStarts
from companion.daemon.flights.flights import Flights
from companion.daemon.flights.live_flight import Given, Listener, LiveFlight
from companion.daemon.health_watch import HealthWatch
from companion.daemon.obstacle_reports import ObstacleReports
from companion.daemon.pose.senders import Senders
from companion.messages import NO_PICTURE, Georeferenced, Odometry, Warned
from companion.runtime.stage_protocol import ResultsWritten, Snapshot
from companion.timing.clock import FlightClock
from drivers.system.journal import Journal

NOT_WRITTEN = "the results so far could not be written"


class FlightOutputs:
    """Listeners of flights. What they take comes from any thread; `soon` calls in the event loop.

    `obstacles` are looked for, or not.
    """

    def __init__(
        self, flights: Flights, starts: FlightStarts, watch: HealthWatch, senders: Senders | None,
        obstacles: ObstacleReports | None, ground: GroundControl | None, journal: Journal,
        clock: FlightClock, warn: Callable[[Warned], None], soon: Callable[..., None],
    ) -> None:  # fmt: skip
        self._flights, self._starts, self._watch = flights, starts, watch
        self._senders, self._obstacles, self._ground = senders, obstacles, ground
        self._journal, self._clock, self._warn, self._soon = journal, clock, warn, soon

    def listener(self, flight: LiveFlight) -> Listener:
        """Callbacks for the output of a flight, active while that flight is the current one."""

        def current(take: Callable[[Any], None]) -> Callable[[Any], None]:
            def later(message: Any) -> None:
                if self._flights.current is flight:
                    take(message)

            return lambda message: self._soon(later, message)

        to_senders = current(self._senders.take if self._senders is not None else _nothing)

        def warned(warning: Warned) -> None:
            self._warn(warning)
            to_senders(warning)

        obstacles = self._obstacles
        return Listener(
            given=current(self._given),
            warned=warned,
            localisation_died=lambda: self._soon(self._starts.localisation_died, flight),
            unusable=lambda why: self._soon(self._starts.stage_unusable, why),
            results_written=self._results_written,
            points_made=current(self._watch.points_made),
            mapped=current(obstacles.take) if obstacles is not None else None,
        )

    def _given(self, message: Given) -> None:
        """Take an output of the current flight's stages."""
        if isinstance(message, Snapshot):
            if self._ground is not None:
                self._ground.snapshot_told(message)
        elif isinstance(message, Georeferenced):
            self._watch.take_georeference(message)
            if self._ground is not None:
                self._ground.way_back.take_georeference(message)
        elif isinstance(message, Odometry) and message.seq < NO_PICTURE:
            self._watch.take_odometry(message)
            if self._ground is not None:
                self._ground.way_back.take_odometry(message)
        if self._senders is not None:
            self._senders.take(message)

    def _results_written(self, written: ResultsWritten) -> None:
        if written.why_not:
            self._warn(Warned(self._clock.now_ns(), NOT_WRITTEN, written.why_not))
        else:
            self._journal.say(f"results so far: {written.folder}")


def _nothing(_message: object) -> None:
    """Take a message that goes nowhere: there is no autopilot."""
