"""The daemon: joins camera, autopilot and stages, from power on to power off.

The event loop does I/O only. The camera has a thread, every heavy stage a process; their output
comes in by `call_soon_threadsafe`. A camera, link or stage that fails is reported and restarted; a
bug in what the pose can do without ends that part alone (`_spared_work`), and one elsewhere ends
the daemon, which the service manager starts again with the map that was kept.
"""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable, Coroutine
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from companion.config import Config
from companion.daemon.component_state import POWEROFF
from companion.daemon.control.armed_settings import NOT_KEPT
from companion.daemon.control.ground_control import GroundControl
from companion.daemon.control.settings_in_force import SettingsInForce
from companion.daemon.flight_outputs import FlightOutputs
from companion.daemon.flight_starts import NOT_BEGUN, FlightStarts
from companion.daemon.flights.flight_dates import FlightDates
from companion.daemon.flights.flight_facts import facts_of
from companion.daemon.flights.flights import Flights
from companion.daemon.flights.live_flight import LiveFlight
from companion.daemon.flights.recording_recovery import RecordingRecovery
from companion.daemon.health_watch import HealthWatch
from companion.daemon.link_watch import LinkWatch
from companion.daemon.loop_delay import measure_loop_delay
from companion.daemon.page_child import PageChild, SettingsSource
from companion.daemon.periodic_checks import PeriodicChecks
from companion.daemon.pose.senders import Senders
from companion.daemon.recorder_notes import RecorderNotes
from companion.daemon.setup_proof import SetupProof
from companion.daemon.spared import spared
from companion.daemon.status_document import StatusDocument
from companion.daemon.stop_request import StopRequest
from companion.daemon.vehicle_reports import VehicleReports, flight_recording
from companion.geometry.geodesy import GeoOrigin
from companion.messages import Frame, Warned
from companion.messages.run_facts import RunFacts
from companion.meters import LatencyMeter
from companion.pilot_messages import PilotText, of_warning
from companion.runtime.stage_start import Start
from companion.telemetry import (
    ArmedSample,
    Telemetry,
    belief_in_words,
)
from companion.timing.clock import FlightClock
from companion.timing.overdue_frames import OVERDUE_NS, OverdueFrames
from drivers.camera.camera_feed import CameraFeed
from drivers.camera.camera_registry import camera_source
from drivers.camera.live_calibration import check_calibration, is_on_gimbal
from drivers.mavlink.autopilot_date import AutopilotDate
from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.mavlink.origin_keeper import OriginKeeper
from drivers.mavlink.wire.link_port import link_port
from drivers.system.clock_is_set import clock_is_set
from drivers.system.journal import WARNING, Journal
from drivers.system.service_manager import ServiceManager
from drivers.system.status_socket import StatusSocket, own_socket_path

if TYPE_CHECKING:
    from drivers.system.metrics import Metrics

LEAST_WAIT_S = 0.005
WRITE_S = 0.2
"""Time to write the armed settings at the end."""
END_S = 2.6
"""Longest stop once in a hurry, whatever hangs."""


class Daemon:
    """All parts of the daemon; `run` gives the exit status. Create it within the event loop."""

    def __init__(self, load: Callable[[], Config], start: Start, source: SettingsSource) -> None:
        self._clock = clock = FlightClock()
        self._journal = journal = Journal()
        self._loop = asyncio.get_running_loop()
        self._stop = StopRequest(journal)
        self._settings = settings = SettingsInForce(
            load, self._autopilot_boot_s, self._is_heard, journal, self._tell_pilot,
            partial(self._problem, NOT_KEPT), self._reconfigured,
        )  # fmt: skip
        config = settings.config
        self._proof = proof = SetupProof(config, self._tell_pilot, partial(self._problem, NOT_KEPT))
        check_calibration(config.camera, config.mount)
        self._service = ServiceManager()
        self._loop_delay = LatencyMeter()
        self._overdue = OverdueFrames()
        self._feed = CameraFeed(
            camera_source(config.camera), clock, config.camera, self._on_frame, self._on_warned
        )
        self._link: AutopilotLink | None = None
        self._senders: Senders | None = None
        self._reports: VehicleReports | None = None
        self._ground: GroundControl | None = None
        link_watch: LinkWatch | None = None
        date: AutopilotDate | None = None
        if config.link.url:
            port = link_port(config.link, config.router, clock)
            link_watch = LinkWatch(port, self._on_warned)
            self._link = AutopilotLink(
                config.link, port, clock, self._on_telemetry, self._on_warned,
                is_on_gimbal(config.camera, config.mount),
            )  # fmt: skip
            self._senders = Senders(
                config, self._link, clock, self._on_warned, lambda step: self._flights.take(step)
            )
            date = AutopilotDate(self._link)
        dates = FlightDates(
            clock, lambda: date.ahead_ns if date is not None else None, clock_is_set
        )
        self._flights = flights = Flights(
            clock, journal, lambda flight: self._outputs.listener(flight), self._facts, dates, start
        )
        self._watch = watch = HealthWatch(
            config, clock, journal, self._feed, self._link, self._senders, flights, self._loop_delay
        )
        watch.set_by_ground = settings.by_ground
        self._notes = RecorderNotes(clock, flights, watch, self._link)
        if self._link is not None:
            self._reports = VehicleReports(
                self._link, clock, watch, config, flights.take,
                flight_recording(config, flights, lambda: self._starts.end_flight()),
            )  # fmt: skip
        self._starts = starts = FlightStarts(
            settings, self._feed, flights, self._senders, self._reports, watch, journal, self._stop,
            partial(self._problem, NOT_BEGUN),
        )  # fmt: skip
        if self._link is not None and self._reports is not None and config.control.enabled:
            self._ground = GroundControl(
                starts, self._link, clock, journal, flights,
                self._reports.questions(lambda: settings.config.feedback), settings.by_ground,
                self._on_warned,
            )  # fmt: skip
        self._outputs = FlightOutputs(
            flights, starts, watch, self._senders,
            self._reports.obstacles if self._reports is not None else None, self._ground, journal,
            clock, self._on_warned, self._soon,
        )  # fmt: skip
        self._checks = PeriodicChecks(
            settings, clock, journal, self._service, self._feed, self._link, link_watch, flights,
            dates, watch, starts, proof, self._stop,
        )  # fmt: skip
        self._status = StatusDocument(
            watch, settings, flights, starts, proof, self._link, journal, clock
        )
        self._page: PageChild | None = None
        if config.page.listen:
            self._page = PageChild(
                config, source, own_socket_path(config.daemon.socket), self._service.is_there,
                journal, lambda: settings.armed, self._checks.reload, watch.keep_viewer,
                self._stop,
            )  # fmt: skip
        self._recovery = RecordingRecovery(
            Path(config.daemon.flights), clock, self._on_warned, lambda: starts.reported_armed
        )

    async def run(self) -> int:
        """Run until stopped or unable to continue; the exit status."""
        loop, config = self._loop, self._settings.config
        loop.add_signal_handler(signal.SIGINT, self._stop.interrupt)
        loop.add_signal_handler(signal.SIGTERM, self._stop.stop)
        loop.add_signal_handler(signal.SIGHUP, self._checks.reload)
        socket = StatusSocket(own_socket_path(config.daemon.socket), self._status, self._problem)
        await socket.start()  # a second daemon ends here, and says nothing else
        self._settings.say_resumed()
        if belief := belief_in_words(config.telemetry.use):
            self._journal.say(belief, WARNING)
        parts: list[StatusSocket | Metrics] = [socket]
        if config.daemon.prometheus_port:
            parts.append(self._metrics(config.daemon.prometheus_port))
            await parts[-1].start()
        self._feed.start()
        tasks = [loop.create_task(each) for each in self._work()]
        spared_tasks = [loop.create_task(each) for each in self._spared_work()]
        stopped: asyncio.Task[Any] = loop.create_task(self._stop.wait())
        try:
            await asyncio.wait([stopped, *tasks], return_when=asyncio.FIRST_COMPLETED)
            for task in tasks:
                if task.done() and not task.cancelled():
                    task.result()  # raises what has ended it
        finally:
            self._service.stopping()
            if self._link is not None:
                self._link.system_status = POWEROFF
                self._link.send(self._link.heartbeat())
            tasks[0].cancel()  # what is checked is being taken apart
            feed_closed = loop.run_in_executor(None, self._feed.stop)
            await self._flights.close(
                END_S, lambda: self._stop.hurried, keep_map=self._settings.armed
            )
            for task in (stopped, *tasks, *spared_tasks):
                task.cancel()
            await asyncio.gather(stopped, *tasks, *spared_tasks, return_exceptions=True)
            for part in reversed(parts):
                await part.stop()
            await asyncio.wait([feed_closed], timeout=0.2)
            await loop.run_in_executor(None, self._settings.close, WRITE_S)
            await loop.run_in_executor(None, self._proof.close, WRITE_S)
            if self._ground is not None:
                await loop.run_in_executor(None, self._ground.close, WRITE_S)
            self._service.close()
        self._journal.say("stopped")
        return self._stop.status

    def _metrics(self, port: int) -> Metrics:
        from drivers.system.metrics import Metrics  # 3 MB of libraries, for who asks for it

        return Metrics(port, self._watch.health, self._problem)

    def _work(self) -> list[Coroutine[Any, Any, None]]:
        """Tasks of the event loop, the periodic checks first."""
        work: list[Coroutine[Any, Any, None]] = [
            self._checks.run(),
            self._watch.govern(),
            self._notice_overdue(),
        ]
        feedback = self._settings.config.feedback
        for part in (self._link, self._senders, self._reports, self._ground):
            if part is not None:
                work.append(part.run())
        if self._link is not None and feedback.set_origin:
            keeper = OriginKeeper(
                feedback, self._link, self._journal.say,
                lambda: self._settings.config.feedback.mode != "off", self._believed_origin,
                lambda: "satellites" in self._settings.config.telemetry.use,
            )  # fmt: skip
            work.append(keeper.run())
        return work

    def _spared_work(self) -> list[Coroutine[Any, Any, None]]:
        """Tasks of the event loop that the pose does not need."""
        work = {
            "the event loop's delay": measure_loop_delay(self._clock, self._loop_delay),
            "the recorder's notes": self._notes.run(),
            "the repair of recordings": self._recovery.run(),
        }
        if self._page is not None:
            work["the page"] = self._page.run()
        return [spared(name, part, self._problem) for name, part in work.items()]

    # -- what comes in --------------------------------------------------------------------------

    def _on_frame(self, frame: Frame) -> None:
        """Take a frame; in the camera's thread."""
        self._watch.frame_came(frame.t_ns)
        self._overdue.came(frame, self._clock.now_ns())
        if self._reports is not None:
            self._reports.frame(frame)
        if self._starts.camera is None:
            self._soon(self._starts.camera_known)
            return
        self._flights.frame(frame)

    async def _notice_overdue(self) -> None:
        """Tell the flight of frames that do not come; ends by cancellation."""
        while True:
            now_ns = self._clock.now_ns()
            notice = self._overdue.due(now_ns)
            if notice is not None:
                self._flights.take(notice)
            due_ns = self._overdue.due_ns() or now_ns + OVERDUE_NS
            await asyncio.sleep(max((due_ns - now_ns) * 1e-9, LEAST_WAIT_S))

    def _on_warned(self, warning: Warned) -> None:
        """Take a warning; in any thread."""
        if self._journal.warn(warning):
            text = of_warning(warning.what, warning.detail, warning.good)
            if text is not None:
                self._soon(self._tell_pilot, text)
        self._soon(self._proof.take, warning)
        self._soon(self._flights.take, warning)

    def _on_telemetry(self, sample: Telemetry) -> None:
        """Take a sample; in the event loop."""
        self._flights.take(sample)
        self._feed.exposure.take_telemetry(sample)
        if self._senders is not None:
            self._senders.take(sample)
        if isinstance(sample, ArmedSample):
            self._starts.set_armed(sample.armed)
            if sample.armed:
                self._watch.armed()

    def _reconfigured(self, old: Config, config: Config) -> None:
        self._checks.reconfigure(old, config)
        self._watch.reconfigure(config)
        if self._senders is not None:
            self._senders.reconfigure(config.feedback)
        self._starts.reconfigure(old, config)

    # -- what the parts ask for -----------------------------------------------------------------

    def _facts(self, flight: LiveFlight) -> RunFacts:
        link, config = self._link, self._settings.config
        if link is None:
            return facts_of(flight, config, None, None, {})
        return facts_of(flight, config, link.clock_filter.report(), link.origin, link.rates_hz)

    def _believed_origin(self) -> GeoOrigin | None:
        """Origin of positions; None where one kind of them is not believed: it may come of both."""
        believed = {"position", "satellites"} <= set(self._settings.config.telemetry.use)
        return self._link.origin if self._link is not None and believed else None

    def _autopilot_boot_s(self) -> float | None:
        """Boot time of the autopilot, CLOCK_MONOTONIC; None while its clock is unknown."""
        report = self._link.clock_filter.report() if self._link is not None else None
        return None if report is None else report.offset_s - self._clock.epoch_ns * 1e-9

    def _is_heard(self) -> bool:
        return self._link is not None and self._link.alive

    def _tell_pilot(self, text: PilotText) -> None:
        if self._link is not None:
            self._link.say(text)

    def _problem(self, what: str, detail: str = "") -> None:
        self._on_warned(Warned(self._clock.now_ns(), what, detail))

    def _soon(self, call: Callable[..., object], *arguments: Any) -> None:
        """Call in the event loop; from any thread, ignored once the loop has ended."""
        try:
            self._loop.call_soon_threadsafe(call, *arguments)
        except RuntimeError:
            pass


async def _run(load: Callable[[], Config], start: Start, source: SettingsSource) -> int:
    return await Daemon(load, start, source).run()


def run(load: Callable[[], Config], start: Start, source: SettingsSource) -> int:
    """Run the daemon with the configuration that `load` reads from `source`; the exit status.

    `start` starts processes of stages.
    """
    return asyncio.run(_run(load, start, source))
