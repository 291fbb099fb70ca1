"""Begin and end of flights: at once or by the autopilot's first word, by the ground, on failures.

Localisation runs from power-on, so that poses are there before the motors are armed. Arming marks
the flight to be kept; after disarming it goes on, so that another take-off has the same map.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace

from companion.config import Config, DaemonConfig, FeedbackConfig
from companion.daemon.control.settings_in_force import SettingsInForce
from companion.daemon.flights.flights import Flights
from companion.daemon.flights.flown_stages import makes_depth
from companion.daemon.flights.live_flight import LiveFlight
from companion.daemon.health_watch import HealthWatch
from companion.daemon.pose.senders import Senders
from companion.daemon.stop_request import BAD_INPUT, StopRequest
from companion.daemon.vehicle_reports import VehicleReports
from companion.errors import CompanionError
from companion.geometry.camera import Camera
from companion.runtime.in_processes import in_words
from drivers.camera.camera_feed import CameraFeed
from drivers.camera.live_calibration import live_camera
from drivers.system.journal import WARNING, Journal

STANDBY_RETRY_S = 1.0
SHORT_S, LONGEST_PAUSE_S = 10.0, 10.0
"""Time before which the death of localisation is one of several, and the longest pause then."""
REST_S, PREPARE_S, CHANGED_S = 600.0, 15.0, 1.0
"""Time on the ground after which a flight gives way to another: bounds what is recorded of a
vehicle that only stands there. The other's stages start so much earlier. After a change of settings
it comes soon: a ground station sets several, one after the other."""
NOT_BEGUN = "no flight can begin now, which is tried again"


class FlightStarts:
    """Begins and ends flights, and prepares the standby one. Used in the event loop.

    It is the daemon as `control.ground_control` sees it. `not_begun` takes the reason why the
    processes of a flight cannot be started now.
    """

    def __init__(
        self, settings: SettingsInForce, feed: CameraFeed, flights: Flights,
        senders: Senders | None, reports: VehicleReports | None, watch: HealthWatch,
        journal: Journal, stop: StopRequest, not_begun: Callable[[str], None],
    ) -> None:  # fmt: skip
        self._loop = asyncio.get_running_loop()
        self._settings, self._feed, self._flights = settings, feed, flights
        self._senders, self._reports, self._watch = senders, reports, watch
        self._journal, self._stop, self._not_begun = journal, stop, not_begun
        self.camera: Camera | None = None
        """Calibrated camera; None before its first frame."""
        self.reported_armed = False
        """Last state of the motors that this process has heard."""
        self._is_heard = False
        """True once the autopilot has said whether its motors are armed."""
        self._later: asyncio.TimerHandle | None = None
        self._rest: asyncio.TimerHandle | None = None
        """Until a flight on the ground gives way to another."""
        self._n_short = 0
        """Flights in a row whose localisation died early."""

    @property
    def config(self) -> Config:
        """Configuration in force."""
        return self._settings.config

    @property
    def armed(self) -> bool:
        """True while the motors are armed; the last known state while the autopilot is silent."""
        return self._settings.armed

    def take_over(self, config: Config) -> None:
        """Continue with another configuration: at once where possible, else with the next map."""
        self._settings.take_over(config)

    def prepare(self) -> None:
        """Start the processes of a standby flight."""
        if self.camera is not None:
            try:
                self._flights.prepare(self.config, self.camera)
            except (OSError, RuntimeError) as error:
                self._try_again(error)

    def begin_flight(self) -> None:
        """Begin a flight with a map of its own, where one is due."""
        self._begin_if_due(take_up=False)

    def end_flight(self) -> bool:
        """End the current flight, which another follows; False where it must go on: armed."""
        if not self._on_ground or self.armed:
            return False
        self._give_way()
        return True

    def camera_known(self) -> None:
        """Calibrate the camera by the size of its first frame, and begin a flight where one is due.

        Called again it does nothing.
        """
        size = self._feed.size
        if self.camera is not None or size is None:
            return
        try:
            self.camera, remarks = live_camera(self.config.camera, self.config.mount, *size)
        except CompanionError as error:
            self._stop.fail(str(error), BAD_INPUT)
            return
        self._feed.exposure.focal_px = self.camera.focal_px
        for remark in remarks:
            self._journal.say(remark, WARNING)
        self._begin_if_due()

    def set_armed(self, armed: bool) -> None:
        """Take the state of the motors from the autopilot."""
        self._settings.set_armed(armed)
        self._is_heard = True
        if armed != self.reported_armed:
            self.reported_armed = armed
            self._journal.say("armed" if armed else "disarmed")
            self._step_flight(armed)
        self._begin_if_due()

    def reconfigure(self, old: Config, config: Config) -> None:
        """Apply a changed configuration to the current flight, or to the one on standby."""
        flight = self._flights.current
        if flight is not None and old.feedback.mode == "off" != config.feedback.mode:
            self._flights.end()  # a map whose scale is the autopilot's own is none to fly on
            self._begin_if_due(take_up=False)
            return
        if flight is not None and old.feedback.flow == "off" != config.feedback.flow:
            self._flights.end()  # its localisation measures no flow
            self._begin_if_due(take_up=False)
            return
        if flight is None:
            self._flights.discard_standby()
            self._begin_later(STANDBY_RETRY_S)
        elif self._on_ground and _of_stages(old) != _of_stages(config):
            self._rest_for(CHANGED_S, self._give_way)
        else:
            flight.set_dense(makes_depth(config))
            flight.set_budget(config.stream.budget_kbit_s)

    def localisation_died(self, flight: LiveFlight) -> None:
        """Begin another flight, or prepare another standby one, in place of `flight`.

        The first time at once; where it dies soon again, after a pause: each flight has processes,
        a folder and a recording.
        """
        if self._flights.current is flight:
            self._n_short = self._n_short + 1 if flight.duration_s < SHORT_S else 0
            self._flights.end()
            if self._n_short < 2:
                self._begin_if_due()
            else:
                self._watch.flight_due = True
                self._begin_later(min(2.0 ** min(self._n_short - 1, 10), LONGEST_PAUSE_S))
        elif self._flights.standby is flight:
            self._flights.discard_standby()
            self._begin_later(STANDBY_RETRY_S)

    def stage_unusable(self, why: str) -> None:
        """On the ground exit with the error; in the air the pose goes on without the stage."""
        if not self.reported_armed:
            self._stop.fail(why, BAD_INPUT)

    @property
    def _always(self) -> bool:
        return self.config.daemon.flight == "always" or self._senders is None

    @property
    def _on_ground(self) -> bool:
        """True where nobody minds that another map begins."""
        return not (self._always or self.reported_armed)

    def _step_flight(self, armed: bool) -> None:
        """Keep the current flight from arming on; at disarming write what there is of it."""
        if self._always:
            return
        if armed:
            self._flights.keep()
            if self._flights.current is not None:
                self._flights.discard_standby()
        else:
            self._flights.write_results()
        self._begin_rest()

    def _begin_rest(self) -> None:
        """Have the current flight give way to another in a while, unless armed by then."""
        if self._on_ground:
            self._rest_for(REST_S - PREPARE_S, self._end_rest)
        elif self._rest is not None:
            self._rest.cancel()

    def _end_rest(self) -> None:
        self.prepare()
        self._rest_for(PREPARE_S, self._give_way)

    def _rest_for(self, pause_s: float, then: Callable[[], None]) -> None:
        if self._rest is not None:
            self._rest.cancel()
        self._rest = self._loop.call_later(pause_s, then)

    def _give_way(self) -> None:
        self._flights.end()
        self._begin_if_due(take_up=False)

    def _begin_if_due(self, take_up: bool = True) -> None:
        if self.camera is None or self._flights.current is not None or self._stop.made:
            return
        self._watch.flight_due = self._always or self._is_heard
        try:
            self._flights.prepare(self.config, self.camera)
            if self._watch.flight_due:
                self._begin(self.camera, take_up)
        except (OSError, RuntimeError) as error:  # no process, thread or descriptor for it
            self._try_again(error, take_up)

    def _begin(self, camera: Camera, take_up: bool) -> None:
        if self._senders is not None:
            self._senders.restart()
        if self._reports is not None:
            self._reports.restart(camera)
        self._watch.restart()
        flight = self._flights.begin(self.config, camera, take_up, keep=not self._on_ground)
        self._watch.flight_due = False
        self._begin_rest()
        if self._senders is not None:
            self._senders.begin_flight(flight.believed)

    def _try_again(self, error: OSError | RuntimeError, take_up: bool = True) -> None:
        self._not_begun(in_words(error))
        self._begin_later(STANDBY_RETRY_S, take_up)

    def _begin_later(self, pause_s: float, take_up: bool = True) -> None:
        if self._later is not None:
            self._later.cancel()
        self._later = self._loop.call_later(pause_s, self._begin_if_due, take_up)


def _of_stages(config: Config) -> Config:
    """The part of a configuration with which a flight's stages begin, and stay."""
    return replace(
        config,
        feedback=FeedbackConfig(max_jump_m=config.feedback.max_jump_m),
        daemon=DaemonConfig(),
        depth=replace(config.depth, enabled=True),
        stream=replace(config.stream, budget_kbit_s=0.0),
    )
