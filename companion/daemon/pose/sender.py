"""Interface of what sends one kind of message to the autopilot."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any

from companion.config import FeedbackConfig, Measurement
from companion.estimation.satellites.satellite_watch import doubts
from companion.messages import Warned


class Sender:
    """Base class of senders; they work in the event loop."""

    name = ""
    """Name of its health in `companion.health.Health`; "" without one."""
    takes: Mapping[type, Callable[[Any], None]]
    """Messages of the flight and samples of the autopilot that it takes, by kind."""

    def begin_flight(self, use: Collection[Measurement]) -> None:
        """A flight has begun, and its recording; of telemetry it believes what is in `use`."""

    def reconfigure(self, config: FeedbackConfig) -> None:
        """Apply other limits and messages from the next frame on."""

    async def run(self) -> None:
        """Send what is due between frames, until cancelled; most have nothing."""

    def health(self) -> Any:
        """Health now; None without a name."""
        return None

    def take_warning(self, warning: Warned) -> None:
        """Take a warning of localisation; those that change its verdict on satellites count."""
        doubted = doubts(warning)
        if doubted is not None:
            self.doubt_satellites(doubted)

    def doubt_satellites(self, doubted: bool) -> None:
        """Satellites are doubted, or are not any more; most do not care."""
