"""The landing marker to the autopilot: LANDING_TARGET for each frame that shows it for certain.

Runs in the event loop. Which positions are sent is decided by
`companion.estimation.landing.landing_gate`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection

from companion.config import LandingConfig, Measurement
from companion.daemon.pose.sender import Sender
from companion.estimation.gate.gate_journal import LANDING, GateJournal
from companion.estimation.gate.gates_again import FRAME
from companion.estimation.landing.landing_gate import LandingGate
from companion.flight_notes import GateStep
from companion.health import LandingHealth
from companion.messages import LandingTarget
from companion.meters import LatencyMeter, RateMeter
from companion.pilot_messages import MARKER_LOST, MARKER_SEEN
from companion.telemetry import AttitudeSample
from companion.timing.clock import FlightClock
from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.mavlink.measurements.landing_messages import LocalPosition, landing_target_message

LOST_NS = 1_000_000_000
"""The pilot is told after this long without a position: single frames miss it now and then."""
UNHEARD, NO_POSITION = "the autopilot is silent", "no local position from the autopilot"


class LandingSender(Sender):
    """Landing targets of the current flight in; LANDING_TARGET out, or nothing.

    Of telemetry it believes what is in `use`. `journal` takes what the gate was asked.
    """

    name = "landing"

    def __init__(
        self,
        config: LandingConfig,
        link: AutopilotLink,
        clock: FlightClock,
        use: Collection[Measurement],
        journal: Callable[[GateStep], None],
    ) -> None:
        self._config, self._link, self._clock = config, link, clock
        self._gate, self._local = LandingGate(use), LocalPosition(link)
        self._journal = GateJournal(LANDING, journal)
        self._rate, self._latency = RateMeter(), LatencyMeter()
        self._n_sent, self._sent_ns = 0, 0
        self._distance_m: float | None = None
        self._why_not = ""
        self._is_told = False
        self.takes = {AttitudeSample: self.take_attitude, LandingTarget: self.take}

    def begin_flight(self, use: Collection[Measurement]) -> None:
        """Begin anew with another flight, of whose telemetry is believed what is in `use`."""
        self._gate = LandingGate(use)
        self._journal.begin(self._clock.now_ns(), {})

    def take_attitude(self, sample: AttitudeSample) -> None:
        """Take an attitude of the autopilot."""
        self._journal.sample()
        self._gate.take_attitude(sample)

    def take(self, target: LandingTarget) -> None:
        """Send the position of a frame, or not."""
        now_ns = self._clock.now_ns()
        self._why_not = self._send(target, now_ns)
        sent_lately = now_ns - self._sent_ns < LOST_NS
        if sent_lately != self._is_told:
            if self._link.say(MARKER_SEEN() if sent_lately else MARKER_LOST()):
                self._is_told = sent_lately

    def health(self) -> LandingHealth:
        """Health of the landing marker now."""
        now_ns = self._clock.now_ns()
        return LandingHealth(
            marker=self._config.marker,
            sending=now_ns - self._sent_ns < LOST_NS and self._link.alive,
            why_not=self._why_not,
            rate_hz=self._rate.hz(now_ns),
            distance_m=self._distance_m,
            latency_p50_ms=self._latency.percentile_ms(50, now_ns),
            n_sent=self._n_sent,
        )

    def _send(self, target: LandingTarget, now_ns: int) -> str:
        """Send a position; else why not."""
        passed, vehicle = self._gate.take(target, now_ns), self._link.vehicle
        own_ned_m, why_not = None, ""
        if passed is None:
            why_not = self._gate.why_not
        elif vehicle is None or not self._link.alive:
            why_not = UNHEARD
        elif vehicle.firmware == "px4":
            own_ned_m = self._local.at(passed.t_ns)
            why_not = NO_POSITION if own_ned_m is None else ""
        asked = {"seq": target.seq, "own_ned_m": own_ned_m}
        self._journal.step(FRAME, now_ns, asked, sent=not why_not)
        if passed is None or why_not:
            return why_not
        size_rad = self._config.size_m / passed.distance_m
        self._link.send(landing_target_message(passed, size_rad, own_ned_m))
        self._n_sent, self._sent_ns, self._distance_m = self._n_sent + 1, now_ns, passed.distance_m
        self._rate.add(now_ns)
        self._latency.add(now_ns, (now_ns - target.t_ns) * 1e-6)
        return ""
