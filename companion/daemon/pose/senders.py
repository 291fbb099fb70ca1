"""All that is sent to the autopilot of what the flight sees, each by a sender of its own.

Runs in the event loop. What each was asked goes to the journal, for a replay as flown.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field

from companion.config import Config, FeedbackConfig, Measurement
from companion.daemon.pose.flow_sender import FlowSender
from companion.daemon.pose.global_sender import GlobalSender
from companion.daemon.pose.kept_counter import counter_path
from companion.daemon.pose.landing_sender import LandingSender
from companion.daemon.pose.pose_sender import PoseSender
from companion.daemon.pose.source_switch import SourceSwitch
from companion.estimation.satellites.satellite_watch import doubts
from companion.flight_notes import GateStep
from companion.health import FeedbackHealth, FlowHealth, LandingHealth
from companion.messages import Georeferenced, LandingTarget, Odometry, OpticalFlow, Warned
from companion.telemetry import AttitudeSample, PositionSample, Telemetry
from companion.timing.clock import FlightClock
from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.mavlink.wire.wire import run_together


@dataclass(frozen=True, slots=True)
class SentHealth:
    """Health of all that is sent."""

    feedback: FeedbackHealth = field(default_factory=FeedbackHealth)
    flow: FlowHealth = field(default_factory=FlowHealth)
    landing: LandingHealth = field(default_factory=LandingHealth)
    global_position: FeedbackHealth = field(default_factory=FeedbackHealth)


class Senders:
    """Output of the current flight in, with the autopilot's samples; messages out."""

    def __init__(
        self, config: Config, link: AutopilotLink, clock: FlightClock,
        warn: Callable[[Warned], None], journal: Callable[[GateStep], None],
    ) -> None:  # fmt: skip
        use = config.telemetry.use
        self._poses = PoseSender(
            config.feedback, link, clock, counter_path(config.daemon.flights), warn, journal
        )
        self._flow = FlowSender(config.feedback, link, clock, journal)
        self._landing: LandingSender | None = None
        self._places: GlobalSender | None = None
        self._switch: SourceSwitch | None = None
        if config.landing.marker != "off":
            self._landing = LandingSender(config.landing, link, clock, use, journal)
        if config.feedback.global_position != "off":
            self._places = GlobalSender(config.feedback, link, clock, use, journal)
        if config.gps.switch_source:
            self._switch = SourceSwitch(
                config.gps, link, clock, lambda: self._poses.health().sending, warn, journal
            )

    async def run(self) -> None:
        """Send what is due between frames, until cancelled."""
        switch = [self._switch.run()] if self._switch is not None else []
        await run_together(self._poses.run(), *switch)

    def restart(self) -> None:
        """Begin anew with another localisation."""
        self._poses.restart()

    def begin_flight(self, use: Collection[Measurement]) -> None:
        """A flight has begun, and its recording; of telemetry it believes what is in `use`."""
        self._poses.begin_flight(use)
        self._flow.begin_flight()
        if self._landing is not None:
            self._landing.begin_flight(use)
        if self._places is not None:
            self._places.begin_flight(use)
        if self._switch is not None:
            self._switch.begin_flight()

    def reconfigure(self, config: FeedbackConfig) -> None:
        """Apply other limits and messages from the next frame on."""
        self._poses.reconfigure(config)
        self._flow.reconfigure(config)
        if self._places is not None:
            self._places.reconfigure(config)

    def take_sample(self, sample: Telemetry) -> None:
        """Take a sample of the autopilot, of any kind."""
        if isinstance(sample, AttitudeSample):
            self._poses.take_attitude(sample)
            self._flow.take_attitude(sample)
            if self._landing is not None:
                self._landing.take_attitude(sample)
            if self._places is not None:
                self._places.take_attitude(sample)
        elif isinstance(sample, PositionSample) and self._places is not None:
            self._places.take_position(sample)

    def take_odometry(self, odometry: Odometry) -> None:
        """Take the odometry of a frame."""
        self._poses.take(odometry)
        if self._places is not None:
            self._places.take(odometry)

    def take_georeference(self, told: Georeferenced) -> None:
        """Take the newest place of the map."""
        if self._places is not None:
            self._places.take_georeference(told)

    def take_flow(self, flow: OpticalFlow) -> None:
        """Take the optical flow of a frame."""
        self._flow.take(flow)

    def take_landing(self, target: LandingTarget) -> None:
        """Take the landing target of a frame."""
        if self._landing is not None:
            self._landing.take(target)

    def take_doubt(self, warning: Warned) -> None:
        """Take a warning of localisation; those that change its verdict on satellites count."""
        doubted = doubts(warning)
        if doubted is None:
            return
        if self._places is not None:
            self._places.doubt_satellites(doubted)
        if self._switch is not None:
            self._switch.doubt_satellites(doubted)

    def health(self) -> SentHealth:
        """Health now."""
        return SentHealth(
            self._poses.health(),
            self._flow.health(),
            self._landing.health() if self._landing is not None else LandingHealth(),
            self._places.health() if self._places is not None else FeedbackHealth(),
        )
