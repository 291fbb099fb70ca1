"""The daemon: joins camera, autopilot and stages, from power on to power off.

The event loop does I/O only. The camera has a thread, every heavy stage a process; their output
comes in by `call_soon_threadsafe`. No failure in flight ends it: the part is reported and
restarted.
"""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

from companion.config import Config
from companion.daemon.component_state import POWEROFF, component_state
from companion.daemon.control.armed_settings import NOT_KEPT
from companion.daemon.control.ground_control import GroundControl
from companion.daemon.control.settings_in_force import SettingsInForce
from companion.daemon.flights.flight_dates import FlightDates
from companion.daemon.flights.flight_facts import facts_of
from companion.daemon.flights.flights import Flights
from companion.daemon.flights.live_flight import Listener, LiveFlight, makes_depth
from companion.daemon.flights.recording_recovery import RecordingRecovery
from companion.daemon.health_watch import HealthWatch
from companion.daemon.link_watch import LinkWatch
from companion.daemon.loop_delay import measure_loop_delay
from companion.daemon.missing_devices import MissingDevices
from companion.daemon.pose.kept_counter import counter_path
from companion.daemon.pose.pose_sender import PoseSender
from companion.daemon.recorder_notes import RecorderNotes
from companion.daemon.vehicle_reports import VehicleReports
from companion.errors import CompanionError
from companion.geometry.camera import Camera
from companion.health import LatencyMeter
from companion.messages import Frame, MapUpdate, Odometry, PointChunk, Track, Warned
from companion.pilot_messages import (
    PilotText,
    of_warning,
)
from companion.products.flight_result import RunFacts
from companion.runtime.stage_protocol import Snapshot
from companion.telemetry import ArmedSample, AttitudeSample, Telemetry
from companion.timing.clock import FlightClock
from drivers.camera.camera_feed import CameraFeed
from drivers.camera.camera_registry import camera_source
from drivers.camera.live_calibration import live_camera
from drivers.mavlink.autopilot_date import AutopilotDate
from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.mavlink.origin_keeper import OriginKeeper
from drivers.mavlink.wire.link_port import link_port
from drivers.system.clock_is_set import clock_is_set
from drivers.system.journal import ERROR, WARNING, Journal
from drivers.system.metrics import Metrics
from drivers.system.service_manager import ServiceManager
from drivers.system.status_socket import StatusSocket, own_socket_path

NOT_THERE = ("missing", "driver fault")
"""States of sources that are retried."""
WATCH_S = 0.2
START_S = 180.0
"""Time for stages to start once no device is missing; the first time they compile."""
FAULT, BAD_INPUT = 1, 2
"""Exit statuses."""
NO_PROGRESS = "frames come and no pose, whatever is tried: left to the service manager's watchdog"
STANDBY_RETRY_S = 1.0
WRITE_S = 0.2
"""Time to write the armed settings at the end."""
END_S = 2.6
"""Longest stop, whatever hangs."""


class Daemon:
    """All parts of the daemon; `run` gives the exit status. Create it within the event loop."""

    def __init__(self, load: Callable[[], Config]) -> None:
        self._clock = clock = FlightClock()
        self._journal = Journal()
        self._loop = asyncio.get_running_loop()
        self._settings = SettingsInForce(
            load, self._autopilot_boot_s, self._is_heard, self._journal, self._tell_pilot,
            lambda why: self._on_warned(Warned(clock.now_ns(), NOT_KEPT, why)), self._reconfigured,
        )  # fmt: skip
        config = self.config
        self._stop = asyncio.Event()
        self._status = 0
        self._camera: Camera | None = None
        self._armed = False
        self._service = ServiceManager()
        self._is_ready = False
        self._loop_delay = LatencyMeter()
        self._feed = CameraFeed(
            camera_source(config.camera), clock, config.camera, self._on_frame, self._on_warned
        )
        self._link: AutopilotLink | None = None
        self._link_watch: LinkWatch | None = None
        if config.link.url:
            port = link_port(config.link, config.router, clock)
            self._link_watch = LinkWatch(port, self._on_warned)
            self._link = AutopilotLink(
                config.link, port, clock, self._on_telemetry, self._on_warned
            )
        self._sender: PoseSender | None = None
        if self._link is not None:
            self._sender = PoseSender(
                config.feedback, self._link, clock, counter_path(config.daemon.flights),
                self._on_warned, lambda step: self._flights.take(step),
            )  # fmt: skip
        date = AutopilotDate(self._link) if self._link is not None else None
        self._dates = FlightDates(
            clock, lambda: date.ahead_ns if date is not None else None, clock_is_set
        )
        self._flights = Flights(
            clock, self._journal, self._listener,
            self._facts, self._dates,
        )  # fmt: skip
        self._watch = HealthWatch(
            config, clock, self._journal, self._feed, self._link, self._sender, self._flights,
            self._loop_delay,
        )  # fmt: skip
        self._notes = RecorderNotes(clock, self._flights, self._watch, self._link)
        self._reports: VehicleReports | None = None
        if self._link is not None:
            self._reports = VehicleReports(
                self._link, clock, self._watch, config.feedback.obstacle_distance
            )
        self._recovery = RecordingRecovery(
            Path(config.daemon.flights), clock, self._on_warned, lambda: self._armed
        )
        self._missing = MissingDevices(config.daemon.missing_device_s)
        self._standby_later: asyncio.TimerHandle | None = None
        self._watch.set_by_ground = self._settings.by_ground
        self._ground: GroundControl | None = None
        if self._link is not None and self._reports is not None and config.control.enabled:
            self._ground = GroundControl(
                self, self._link, clock, self._journal, self._flights,
                self._reports.questions(lambda: self.config.feedback), self._settings.by_ground,
                self._on_warned,
            )  # fmt: skip

    async def run(self) -> int:
        """Run until stopped or unable to continue; the exit status."""
        loop, config = self._loop, self.config
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, self._stop.set)
        loop.add_signal_handler(signal.SIGHUP, self._reload)
        socket = StatusSocket(
            own_socket_path(config.daemon.socket), self._watch.document, self._problem
        )
        metrics = Metrics(config.daemon.prometheus_port, self._watch.health, self._problem)
        await socket.start()
        if config.daemon.prometheus_port:
            await metrics.start()
        self._feed.start()
        work: list[Coroutine[Any, Any, None]] = [
            self._run_watch(),
            self._watch.govern(),
            measure_loop_delay(self._clock, self._loop_delay),
            self._notes.run(),
            self._recovery.run(),
        ]
        if self._link is not None:
            work.append(self._link.run())
        if self._link is not None and self._sender is not None:
            work.append(self._sender.run())
            if config.feedback.set_origin:
                keeper = OriginKeeper(
                    config.feedback, self._link, self._journal.say,
                    lambda: self.config.feedback.mode != "off",
                )  # fmt: skip
                work.append(keeper.run())
        if self._reports is not None:
            work.append(self._reports.run())
        if self._ground is not None:
            work.append(self._ground.run())
        tasks = [loop.create_task(each) for each in work]
        stopped: asyncio.Task[Any] = loop.create_task(self._stop.wait())
        try:
            await asyncio.wait([stopped, *tasks], return_when=asyncio.FIRST_COMPLETED)
            for task in tasks:
                if task.done() and not task.cancelled() and task.exception() is not None:
                    raise task.exception() or AssertionError
        finally:
            self._service.stopping()
            if self._link is not None:
                self._link.system_status = POWEROFF
                self._link.send(self._link.heartbeat())
            tasks[0].cancel()  # what is watched is being taken apart
            feed_closed = loop.run_in_executor(None, self._feed.stop)
            await self._flights.close(END_S, keep_map=self.armed)
            for task in (stopped, *tasks):
                task.cancel()
            await asyncio.gather(stopped, *tasks, return_exceptions=True)
            await metrics.stop()
            await socket.stop()
            await asyncio.wait([feed_closed], timeout=0.2)
            await loop.run_in_executor(None, self._settings.close, WRITE_S)
            if self._ground is not None:
                await loop.run_in_executor(None, self._ground.close, WRITE_S)
            self._service.close()
        self._journal.say("stopped")
        return self._status

    # -- what comes in --------------------------------------------------------------------------

    def _on_frame(self, frame: Frame) -> None:
        """Take a frame; in the camera's thread."""
        self._watch.frame_came()
        if self._camera is None:
            self._soon(self._camera_known)
            return
        self._flights.frame(frame)

    def _on_warned(self, warning: Warned) -> None:
        """Take a warning; in any thread."""
        if self._journal.warn(warning):
            text = of_warning(warning.what, warning.detail, warning.good)
            if text is not None:
                self._soon(self._tell_pilot, text)
        self._soon(self._flights.take, warning)

    def _on_telemetry(self, sample: Telemetry) -> None:
        """Take a sample; in the event loop."""
        self._flights.take(sample)
        if isinstance(sample, AttitudeSample):
            if self._sender is not None:
                self._sender.take_attitude(sample)
        elif isinstance(sample, ArmedSample):
            self._set_armed(sample.armed)

    def _listener(self, flight: LiveFlight) -> Listener:
        """Callbacks for the output of a flight, active while that flight is the current one."""

        def current(take: Callable[[Any], None]) -> Callable[[Any], None]:
            def later(message: Any) -> None:
                if self._flights.current is flight:
                    take(message)

            return lambda message: self._soon(later, message)

        needs_map = self._reports is not None and self.config.feedback.obstacle_distance
        return Listener(
            odometry=current(self._on_odometry),
            georeferenced=current(self._watch.take_georeference),
            warned=self._on_warned,
            localisation_died=lambda: self._soon(self._localisation_died, flight),
            unusable=lambda why: self._soon(self._unusable, why),
            snapshot=current(self._on_snapshot),
            points_made=current(self._watch.points_made),
            mapped=current(self._on_mapped) if needs_map else None,
        )

    def _facts(self, flight: LiveFlight) -> RunFacts:
        link = self._link
        if link is None:
            return facts_of(flight, self.config, None, None, {})
        clock = link.clock_filter.report()
        return facts_of(flight, self.config, clock, link.origin, link.rates_hz)

    def _on_odometry(self, odometry: Odometry) -> None:
        self._watch.take_odometry(odometry)
        if self._sender is not None:
            self._sender.take(odometry)

    def _on_mapped(self, message: Track | MapUpdate | PointChunk) -> None:
        if self._reports is not None:
            self._reports.take(message)

    def _on_snapshot(self, snapshot: Snapshot) -> None:
        if self._ground is not None:
            self._ground.snapshot_told(snapshot)

    # -- flights --------------------------------------------------------------------------------

    def _camera_known(self) -> None:
        size = self._feed.size
        if self._camera is not None or size is None:
            return
        try:
            self._camera, remarks = live_camera(self.config.camera, self.config.mount, *size)
        except CompanionError as error:
            self._give_up(str(error), BAD_INPUT)
            return
        for remark in remarks:
            self._journal.say(remark, WARNING)
        self._begin_if_due()

    @property
    def _always(self) -> bool:
        return self.config.daemon.flight == "always" or self._link is None

    def _begin_if_due(self, take_up: bool = True) -> None:
        if self._camera is None or self._flights.current is not None or self._stop.is_set():
            return
        if self._always or self._armed:
            if self._sender is not None:
                self._sender.restart()
            if self._reports is not None:
                self._reports.restart(self._camera)
            self._watch.restart()
            self._flights.begin(self.config, self._camera, take_up)
            if self._sender is not None:
                self._sender.begin_flight()
        else:
            self._flights.prepare(self.config, self._camera)

    def _set_armed(self, armed: bool) -> None:
        self._settings.set_armed(armed)
        if armed == self._armed:
            return
        self._armed = armed
        self._journal.say("armed" if armed else "disarmed")
        if not armed and not self._always:
            self._flights.end()
        self._begin_if_due()

    def _localisation_died(self, flight: LiveFlight) -> None:
        if self._flights.current is flight:
            self._flights.end()
            self._begin_if_due()
        elif self._flights.is_standby(flight):
            self._flights.discard_standby()
            self._loop.call_later(STANDBY_RETRY_S, self._begin_if_due)

    def _unusable(self, why: str) -> None:
        """On the ground exit with the error; in the air the pose goes on without the stage."""
        if not self._armed:
            self._give_up(why, BAD_INPUT)

    # -- watching -------------------------------------------------------------------------------

    async def _run_watch(self) -> None:
        began_ns = self._clock.now_ns()
        progress = True
        while True:
            await asyncio.sleep(WATCH_S)
            if self._link_watch is not None:
                self._link_watch.step(self._clock.now_ns())
            health = self._watch.health()
            if self._link is not None:
                self._link.system_status = component_state(health)
            if self._flights.current is not None:
                origin = self._link.origin if self._link is not None else None
                self._flights.current.publish_health(health, origin)
            now_s = (self._clock.now_ns() - began_ns) * 1e-9
            if not self._is_ready and self._watch.up:
                self._is_ready = True
                self._service.ready(health.tracker)
            elif not self._is_ready and any(each.state in NOT_THERE for each in health.sources):
                self._service.extend_timeout(START_S)
            if not self._watch.pose_loop_alive:
                self._watch.kill_stuck()
            self._watch.end_stalled()
            if progress and not self._watch.progress:
                self._journal.say(NO_PROGRESS, ERROR)
            progress = self._watch.progress
            if progress:
                self._service.alive()
            line = self._watch.line_due()
            if line:
                self._journal.say(line)
                self._service.status(line)
            if self._feed.fault is not None:
                self._give_up(str(self._feed.fault), BAD_INPUT)
            if self._dates.step():
                self._loop.run_in_executor(None, self._dates.write)
            self._settings.step()
            gone = self._missing.step(health, now_s, self._armed)
            if gone:
                self._give_up(gone)

    def _reload(self) -> None:
        """Read the configuration again: SIGHUP."""
        if self._is_ready:
            self._service.reloading()
        self._settings.reload()
        if self._is_ready:
            self._service.ready()

    # -- as the ground has a say, see GroundControl ----------------------------------------------

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

    def _reconfigured(self, old: Config, config: Config) -> None:
        if config.daemon != old.daemon:
            self._missing = MissingDevices(config.daemon.missing_device_s)
        self._watch.reconfigure(config)
        if self._sender is not None:
            self._sender.reconfigure(config.feedback)
        flight = self._flights.current
        if flight is not None and old.feedback.mode == "off" != config.feedback.mode:
            self._flights.end()  # a map whose scale is the autopilot's own is none to fly on
            self._begin_if_due(take_up=False)
            return
        if flight is not None:
            flight.set_dense(makes_depth(config))
            flight.set_budget(config.stream.budget_kbit_s)
            return
        self._flights.discard_standby()
        if self._standby_later is not None:
            self._standby_later.cancel()
        self._standby_later = self._loop.call_later(STANDBY_RETRY_S, self._begin_if_due)

    def _autopilot_boot_s(self) -> float | None:
        """Boot time of the autopilot, CLOCK_MONOTONIC; None while its clock is unknown."""
        report = self._link.clock_filter.report() if self._link is not None else None
        return None if report is None else report.offset_s - self._clock.epoch_ns * 1e-9

    def _is_heard(self) -> bool:
        return self._link is not None and self._link.alive

    def prepare(self) -> None:
        """Start the processes of a standby flight."""
        if self._camera is not None:
            self._flights.prepare(self.config, self._camera)

    def begin_flight(self) -> None:
        """Begin a flight with a map of its own, where one is due."""
        self._begin_if_due(take_up=False)

    def _give_up(self, why: str, status: int = FAULT) -> None:
        if self._status == 0:
            self._journal.say(f"error: {why}", ERROR)
            self._status = status
        self._stop.set()

    def _tell_pilot(self, text: PilotText) -> None:
        if self._link is not None:
            self._link.say(text)

    def _problem(self, text: str) -> None:
        self._on_warned(Warned(self._clock.now_ns(), text))

    def _soon(self, call: Callable[..., object], *arguments: Any) -> None:
        """Call in the event loop; from any thread, ignored once the loop has ended."""
        try:
            self._loop.call_soon_threadsafe(call, *arguments)
        except RuntimeError:
            pass


async def _run(load: Callable[[], Config]) -> int:
    return await Daemon(load).run()


def run(load: Callable[[], Config]) -> int:
    """Run the daemon with the configuration that `load` reads; the exit status."""
    return asyncio.run(_run(load))
