"""Checks every 0.2 s: health, hanging stages, the service manager, missing devices."""

from __future__ import annotations

import asyncio

from companion.config import Config
from companion.daemon.component_state import component_state
from companion.daemon.control.settings_in_force import SettingsInForce
from companion.daemon.flight_starts import FlightStarts
from companion.daemon.flights.flight_dates import FlightDates
from companion.daemon.flights.flights import Flights
from companion.daemon.health_watch import HealthWatch
from companion.daemon.link_watch import LinkWatch
from companion.daemon.setup_proof import SetupProof
from companion.daemon.stop_request import BAD_INPUT, StopRequest
from companion.health import Health
from companion.timing.clock import FlightClock
from drivers.camera.camera_feed import CameraFeed
from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.system.journal import ERROR, WARNING, Journal
from drivers.system.service_manager import ServiceManager
from drivers.system.ticks import tick

EVERY_S = 0.2
START_S = 180.0
"""Time for stages to start once no device is missing; the first time they compile."""
NOT_THERE = ("missing", "driver fault")
"""States of sources that are retried."""
NO_PROGRESS = "frames come and no pose, whatever is tried: left to the service manager's watchdog"


class PeriodicChecks:
    """Reads the health and acts on it. Used in the event loop."""

    def __init__(
        self, settings: SettingsInForce, clock: FlightClock, journal: Journal,
        service: ServiceManager, feed: CameraFeed, link: AutopilotLink | None,
        link_watch: LinkWatch | None, flights: Flights, dates: FlightDates, watch: HealthWatch,
        starts: FlightStarts, proof: SetupProof, stop: StopRequest,
    ) -> None:  # fmt: skip
        self._settings, self._clock, self._journal = settings, clock, journal
        self._service = service
        self._feed, self._link, self._link_watch = feed, link, link_watch
        self._flights, self._dates, self._watch = flights, dates, watch
        self._starts, self._proof, self._stop = starts, proof, stop
        self._missing = MissingDevices(settings.config.daemon.missing_device_s)
        self._is_ready = False
        self._progress = True
        self._told = ""
        """Last problem with the service manager in the journal."""
        self._dating: asyncio.Future[object] | None = None

    async def run(self) -> None:
        """Check until cancelled."""
        began_ns = self._clock.now_ns()
        while True:
            await tick(EVERY_S)
            now_ns = self._clock.now_ns()
            if self._link_watch is not None:
                self._link_watch.step(now_ns)
            health = self._watch.health()
            self._publish(health)
            self._check_start(health)
            self._check_stages()
            self._report(health)
            self._proof.step(
                self._starts.camera, health.feedback.sending, self._settings.armed,
                self._settings.config.feedback.mode != "off",
            )  # fmt: skip
            if self._feed.fault is not None:
                self._stop.fail(str(self._feed.fault), BAD_INPUT)
            self._step_dates()
            self._settings.step()
            gone = self._missing.step(
                health, (now_ns - began_ns) * 1e-9, self._starts.reported_armed
            )
            if gone:
                self._stop.fail(gone)

    def reconfigure(self, old: Config, config: Config) -> None:
        """Apply a changed configuration."""
        if config.daemon != old.daemon:
            self._missing = MissingDevices(config.daemon.missing_device_s)

    def reload(self) -> None:
        """Read the configuration again: SIGHUP."""
        if self._is_ready:
            self._service.reloading()
        self._settings.reload()
        if self._is_ready:
            self._service.ready()

    def _publish(self, health: Health) -> None:
        if self._link is not None:
            self._link.system_status = component_state(health)
        if self._flights.current is not None:
            origin = self._link.origin if self._link is not None else None
            self._flights.current.publish_health(health, origin)

    def _check_start(self, health: Health) -> None:
        if not self._is_ready and self._watch.up:
            self._is_ready = True
            self._service.ready(health.tracker)
        elif not self._is_ready and any(each.state in NOT_THERE for each in health.sources):
            self._service.extend_timeout(START_S)

    def _check_stages(self) -> None:
        """End stages that hang; the service manager is told of life while poses come."""
        if not self._watch.pose_loop_alive:
            self._watch.kill_stuck()
        self._watch.end_stalled()
        progress = self._watch.progress
        if self._progress and not progress:
            self._journal.say(NO_PROGRESS, ERROR)
        self._progress = progress
        if progress:
            self._service.alive()

    def _step_dates(self) -> None:
        """Have due dates written, unless they still are: a disk may hang for long."""
        if self._dates.step() and (self._dating is None or self._dating.done()):
            self._dating = asyncio.get_running_loop().run_in_executor(None, self._dates.write)

    def _report(self, health: Health) -> None:
        line = self._watch.line_due(health)
        if line:
            self._journal.say(line)
            self._service.status(line)
        problem = self._service.problem
        if problem != self._told:
            self._told = problem
            self._journal.say(f"warning: {problem}", WARNING)


class MissingDevices:
    """Reports a camera or an autopilot missing for too long; never in the air."""

    def __init__(self, limit_s: float) -> None:
        self._limit_s = limit_s
        self._since_s: dict[str, float] = {}

    def step(self, health: Health, now_s: float, armed: bool) -> str:
        """Reason to end the daemon; "" without one."""
        for source in health.sources:
            there = source.state not in ("missing", "opening", "silent", "driver fault")
            if there or armed or not self._limit_s:
                self._since_s.pop(source.name, None)
                continue
            since_s = self._since_s.setdefault(source.name, now_s)
            if now_s - since_s > self._limit_s:
                detail = f" ({source.detail})" if source.detail else ""
                return (
                    f"the {source.name} has been {source.state} for {self._limit_s:g} s{detail}; "
                    "expert.daemon.missing_device_s says how long to wait"
                )
        return ""
