"""Begin and end of flights: by arming or at once, by the ground, and after failures."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from companion.config import Config
from companion.daemon.control.settings_in_force import SettingsInForce
from companion.daemon.flights.flights import Flights
from companion.daemon.flights.live_flight import LiveFlight, makes_depth
from companion.daemon.health_watch import HealthWatch
from companion.daemon.pose.pose_sender import PoseSender
from companion.daemon.stop_request import BAD_INPUT, StopRequest
from companion.daemon.vehicle_reports import VehicleReports
from companion.errors import CompanionError
from companion.geometry.camera import Camera
from companion.runtime.processes import in_words
from drivers.camera.camera_feed import CameraFeed
from drivers.camera.live_calibration import live_camera
from drivers.system.journal import WARNING, Journal

STANDBY_RETRY_S = 1.0
SHORT_S, LONGEST_PAUSE_S = 10.0, 10.0
"""Time before which the death of localisation is one of several, and the longest pause then."""
NOT_BEGUN = "no flight can begin now, which is tried again"


class FlightStarts:
    """Begins and ends flights, and prepares the standby one. Used in the event loop.

    It is the daemon as `control.ground_control` sees it. `not_begun` takes the reason why the
    processes of a flight cannot be started now.
    """

    def __init__(
        self, settings: SettingsInForce, feed: CameraFeed, flights: Flights,
        sender: PoseSender | None, reports: VehicleReports | None, watch: HealthWatch,
        journal: Journal, stop: StopRequest, not_begun: Callable[[str], None],
    ) -> None:  # fmt: skip
        self._loop = asyncio.get_running_loop()
        self._settings, self._feed, self._flights = settings, feed, flights
        self._sender, self._reports, self._watch = sender, reports, watch
        self._journal, self._stop, self._not_begun = journal, stop, not_begun
        self.camera: Camera | None = None
        """Calibrated camera; None before its first frame."""
        self.reported_armed = False
        """Last state of the motors that this process has heard."""
        self._later: asyncio.TimerHandle | None = None
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
        for remark in remarks:
            self._journal.say(remark, WARNING)
        self._begin_if_due()

    def set_armed(self, armed: bool) -> None:
        """Take the state of the motors from the autopilot."""
        self._settings.set_armed(armed)
        if armed == self.reported_armed:
            return
        self.reported_armed = armed
        self._journal.say("armed" if armed else "disarmed")
        if not armed and not self._always:
            self._flights.end()
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
        if flight is not None:
            flight.set_dense(makes_depth(config))
            flight.set_budget(config.stream.budget_kbit_s)
            return
        self._flights.discard_standby()
        self._begin_later(STANDBY_RETRY_S)

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
        return self.config.daemon.flight == "always" or self._sender is None

    def _begin_if_due(self, take_up: bool = True) -> None:
        if self.camera is None or self._flights.current is not None or self._stop.made:
            return
        self._watch.flight_due = self._always or self.reported_armed
        try:
            self._flights.prepare(self.config, self.camera)
            if self._watch.flight_due:
                self._begin(self.camera, take_up)
        except (OSError, RuntimeError) as error:  # no process, thread or descriptor for it
            self._try_again(error, take_up)

    def _begin(self, camera: Camera, take_up: bool) -> None:
        if self._sender is not None:
            self._sender.restart()
        if self._reports is not None:
            self._reports.restart(camera)
        self._watch.restart()
        flight = self._flights.begin(self.config, camera, take_up)
        self._watch.flight_due = False
        if self._sender is not None:
            self._sender.begin_flight(flight.believed)

    def _try_again(self, error: OSError | RuntimeError, take_up: bool = True) -> None:
        self._not_begun(in_words(error))
        self._begin_later(STANDBY_RETRY_S, take_up)

    def _begin_later(self, pause_s: float, take_up: bool = True) -> None:
        if self._later is not None:
            self._later.cancel()
        self._later = self._loop.call_later(pause_s, self._begin_if_due, take_up)
