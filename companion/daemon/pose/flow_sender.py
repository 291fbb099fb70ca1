"""Optical flow to the autopilot: one message for each frame, as it comes.

Runs in the event loop. What is sent of it is decided by `companion.estimation.gate.flow_gate`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import asdict

from companion.config import FeedbackConfig, Measurement
from companion.daemon.pose.sender import Sender
from companion.estimation.gate.flow_gate import FlowGate
from companion.estimation.gate.gate_journal import FLOW, GateJournal
from companion.estimation.gate.gates_again import FRAME, LIMITS
from companion.flight_notes import GateStep
from companion.health import FlowHealth
from companion.messages import OpticalFlow
from companion.meters import LatencyMeter, RateMeter
from companion.telemetry import AttitudeSample
from companion.timing.clock import FlightClock
from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.mavlink.measurements.flow_messages import flow_message

SILENT_NS = 1_000_000_000
UNHEARD, NO_FLOW = "the autopilot is silent", "no frame"


class FlowSender(Sender):
    """Optical flow of the current flight in; OPTICAL_FLOW or OPTICAL_FLOW_RAD out, or nothing.

    `journal` takes what the gate was asked.
    """

    name = "flow"

    def __init__(
        self, config: FeedbackConfig, link: AutopilotLink, clock: FlightClock,
        journal: Callable[[GateStep], None],
    ) -> None:  # fmt: skip
        self._config, self._link, self._clock = config, link, clock
        self._gate, self._journal = FlowGate(config), GateJournal(FLOW, journal)
        self._rate, self._latency = RateMeter(), LatencyMeter()
        self._sent_ns = self._taken_ns = 0
        self._quality = 0
        self._why_not = ""
        self._n_sent = 0
        self.takes = {AttitudeSample: self.take_attitude, OpticalFlow: self.take}

    def begin_flight(self, use: Collection[Measurement]) -> None:
        """Begin anew with another flight, of whose telemetry is believed what is in `use`."""
        self._gate = FlowGate(self._config)
        self._journal.begin(self._clock.now_ns(), {})

    def reconfigure(self, config: FeedbackConfig) -> None:
        """Apply another configuration, from the next message on."""
        self._config = config
        self._gate.reconfigure(config)
        self._journal.step(LIMITS, self._clock.now_ns(), {"limits": asdict(config)})

    def take_attitude(self, sample: AttitudeSample) -> None:
        """Take an attitude of the autopilot with its turn rates."""
        self._journal.sample()
        self._gate.take_attitude(sample)

    def take(self, flow: OpticalFlow) -> None:
        """Send the flow of a frame, or not."""
        now_ns = self._clock.now_ns()
        self._taken_ns = now_ns
        if self._config.flow == "off":
            return
        self._why_not = self._send(flow, now_ns) or flow.why_not
        self._quality = 0 if self._why_not else flow.quality

    def health(self) -> FlowHealth:
        """Health of the flow now."""
        if self._config.flow == "off":
            return FlowHealth()
        now_ns = self._clock.now_ns()
        gone = now_ns - self._taken_ns > SILENT_NS
        return FlowHealth(
            message=self._config.flow,
            sending=not gone and now_ns - self._sent_ns < SILENT_NS and self._link.alive,
            why_not=NO_FLOW if gone else self._why_not,
            rate_hz=self._rate.hz(now_ns),
            quality=0 if gone else self._quality,
            latency_p50_ms=self._latency.percentile_ms(50, now_ns),
            n_sent=self._n_sent,
        )

    def _send(self, flow: OpticalFlow, now_ns: int) -> str:
        """Send a flow; else why not."""
        given = self._gate.take(flow, now_ns)
        sent = given is not None and self._link.alive
        self._journal.step(FRAME, now_ns, {"seq": flow.seq}, sent)
        if given is None or not sent:
            return self._gate.why_not if self._link.alive else UNHEARD
        self._link.send(flow_message(given.flow, given.rates_body_rad_s))
        self._gate.sent(now_ns)
        self._n_sent += 1
        self._sent_ns = now_ns
        self._rate.add(now_ns)
        self._latency.add(now_ns, (now_ns - flow.t_ns) * 1e-6)
        return ""
