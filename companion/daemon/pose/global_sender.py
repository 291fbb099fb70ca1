"""Global positions to the autopilot, where no satellites place the map.

Runs in the event loop. A pose passes the same gate as one for ODOMETRY, and then
`companion.estimation.gate.global_gate`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import asdict, astuple

from companion.config import FeedbackConfig, Measurement
from companion.daemon.pose.sender import Sender
from companion.estimation.gate.gate_journal import GLOBAL, GateJournal
from companion.estimation.gate.gates_again import DOUBT, FRAME, LIMITS, PLACED, placed_values
from companion.estimation.gate.global_gate import GlobalGate
from companion.estimation.gate.pose_gate import PoseGate
from companion.flight_notes import GateStep
from companion.health import FeedbackHealth
from companion.messages import Georeferenced, Odometry, Warned
from companion.meters import RateMeter
from companion.pilot_messages import GLOBAL_OFF, GLOBAL_ON
from companion.telemetry import AttitudeSample, PositionSample
from companion.timing.clock import FlightClock
from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.mavlink.measurements.global_messages import RATES_HZ, global_message

LOST_NS = 3_000_000_000
"""The pilot is told after this long without a position."""
UNHEARD = "the autopilot is silent"


class GlobalSender(Sender):
    """Odometry of the current flight in; the message of `feedback.global_position` out.

    `journal` takes what the gates were asked.
    """

    name = "global_position"

    def __init__(
        self,
        config: FeedbackConfig,
        link: AutopilotLink,
        clock: FlightClock,
        use: Collection[Measurement],
        journal: Callable[[GateStep], None],
    ) -> None:
        self._config, self._link, self._clock = config, link, clock
        self._poses, self._gate = PoseGate(config, use=use), GlobalGate(config, use)
        self._journal = GateJournal(GLOBAL, journal)
        self._rate = RateMeter()
        self._n_sent, self._sent_ns, self._sigma_m = 0, 0, 0.0
        self._why_not = ""
        self._is_told = False
        self.takes = {
            AttitudeSample: self.take_attitude, PositionSample: self.take_position,
            Odometry: self.take, Georeferenced: self.take_georeference, Warned: self.take_warning,
        }  # fmt: skip

    def reconfigure(self, config: FeedbackConfig) -> None:
        """Apply another configuration, from the next message on."""
        self._config = config
        self._poses.reconfigure(config)
        self._gate.reconfigure(config)
        self._journal.step(LIMITS, self._clock.now_ns(), {"limits": asdict(config)})

    def take_attitude(self, sample: AttitudeSample) -> None:
        """Take an attitude of the autopilot."""
        self._journal.sample()
        self._poses.take_attitude(sample)

    def take_position(self, sample: PositionSample) -> None:
        """Take a position of the autopilot."""
        self._journal.sample()
        self._gate.take_position(sample)

    def take_georeference(self, told: Georeferenced) -> None:
        """Take the newest place of the map."""
        self._gate.take_georeference(told.georeference)
        self._journal.step(PLACED, self._clock.now_ns(), placed_values(told.georeference))

    def begin_flight(self, use: Collection[Measurement]) -> None:
        """Begin anew with another flight, of whose telemetry is believed what is in `use`."""
        satellites_ns = self._gate.satellites_ns
        self._poses, self._gate = PoseGate(self._config, use=use), GlobalGate(self._config, use)
        self._gate.satellites_ns = satellites_ns
        self._journal.begin(self._clock.now_ns(), {"satellites_ns": satellites_ns})

    def doubt_satellites(self, doubted: bool) -> None:
        """Doubt satellites, or doubt them no more."""
        self._gate.doubted = doubted
        self._journal.step(DOUBT, self._clock.now_ns(), {"doubted": doubted})

    def take(self, odometry: Odometry) -> None:
        """Take the odometry of a frame, and send its position if due and allowed."""
        if self._config.global_position == "off":
            return
        now_ns = self._clock.now_ns()
        self._why_not = self._send(odometry, now_ns)
        sent_lately = now_ns - self._sent_ns < LOST_NS
        if sent_lately != self._is_told:
            if self._link.say(GLOBAL_ON() if sent_lately else GLOBAL_OFF()):
                self._is_told = sent_lately

    def health(self) -> FeedbackHealth:
        """Health of the global position now."""
        now_ns = self._clock.now_ns()
        return FeedbackHealth(
            mode=self._config.global_position,
            sending=now_ns - self._sent_ns < LOST_NS and self._link.alive,
            why_not=self._why_not,
            detail=f"within {self._sigma_m:.1f} m",
            rate_hz=self._rate.hz(now_ns),
            n_sent=self._n_sent,
        )

    def _send(self, odometry: Odometry, now_ns: int) -> str:
        """Send a position; else why not."""
        pose, origin, vehicle = self._poses.take(odometry, now_ns), None, self._link.vehicle
        given, message = None, self._config.global_position
        if pose is not None:
            origin = self._link.origin
            given = self._gate.take(pose, origin, now_ns)
        is_heard = vehicle is not None and self._link.alive
        due = now_ns - self._sent_ns >= 1e9 / RATES_HZ[message]
        system = vehicle.system_id if vehicle is not None else 0
        sent = given is not None and is_heard and due
        asked = {
            "seq": odometry.seq, "origin": None if origin is None else astuple(origin),
            "system": system,
        }  # fmt: skip
        self._journal.step(FRAME, now_ns, asked, sent)
        if pose is None:
            return self._poses.why_not
        if given is None:
            return self._gate.why_not
        if not is_heard:
            return UNHEARD
        if sent:
            self._link.send(global_message(given, message, system, now_ns))
            self._n_sent, self._sent_ns = self._n_sent + 1, now_ns
            self._sigma_m = given.sigma_horizontal_m
            self._rate.add(now_ns)
        return ""
