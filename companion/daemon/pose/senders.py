"""All that is sent to the autopilot of what the flight sees, each by a sender of its own.

Runs in the event loop. What each was asked goes to the journal, for a replay as flown.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

from companion.config import Config, FeedbackConfig, Measurement
from companion.daemon.pose.flow_sender import FlowSender
from companion.daemon.pose.global_sender import GlobalSender
from companion.daemon.pose.kept_counter import counter_path
from companion.daemon.pose.landing_sender import LandingSender
from companion.daemon.pose.pose_sender import PoseSender
from companion.daemon.pose.sender import Sender
from companion.daemon.pose.source_switch import SourceSwitch
from companion.flight_notes import GateStep
from companion.messages import Warned
from companion.timing.clock import FlightClock
from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.mavlink.wire.wire import run_together


class Senders:
    """Output of the current flight in, with the autopilot's samples; messages out."""

    def __init__(
        self, config: Config, link: AutopilotLink, clock: FlightClock,
        warn: Callable[[Warned], None], journal: Callable[[GateStep], None],
    ) -> None:  # fmt: skip
        use, feedback = config.telemetry.use, config.feedback
        poses = self._poses = PoseSender(
            feedback, config.camera.rate_hz, link, clock, counter_path(config.daemon.flights),
            warn, journal,
        )  # fmt: skip
        self._all: list[Sender] = [poses, FlowSender(feedback, link, clock, journal)]
        if config.landing.marker != "off":
            self._all.append(LandingSender(config.landing, link, clock, use, journal))
        if feedback.global_position != "off":
            self._all.append(GlobalSender(feedback, link, clock, use, journal))
        if config.gps.switch_source:
            self._all.append(
                SourceSwitch(config.gps, link, clock, lambda: poses.health().sending, warn, journal)
            )

    async def run(self) -> None:
        """Send what is due between frames, until cancelled."""
        await run_together(*(sender.run() for sender in self._all))

    def restart(self) -> None:
        """Begin anew with another localisation."""
        self._poses.restart()

    def begin_flight(self, use: Collection[Measurement]) -> None:
        """A flight has begun, and its recording; of telemetry it believes what is in `use`."""
        for sender in self._all:
            sender.begin_flight(use)

    def reconfigure(self, config: FeedbackConfig) -> None:
        """Apply other limits and messages from the next frame on."""
        for sender in self._all:
            sender.reconfigure(config)

    def take(self, message: object) -> None:
        """Take a message of the flight or a sample of the autopilot, of any kind."""
        for sender in self._all:
            take = sender.takes.get(type(message))
            if take is not None:
                take(message)

    def health(self) -> dict[str, Any]:
        """Health now, by its name in `companion.health.Health`."""
        return {sender.name: sender.health() for sender in self._all if sender.name}
