"""Poses to the autopilot: each frame's at once, predictions in between, with covariances.

Everything here runs in the event loop. Which poses are sent is decided by
`companion.estimation.gate.pose_gate`.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection
from pathlib import Path

from companion.config import FeedbackConfig, Measurement
from companion.daemon.pose.sender import Sender
from companion.daemon.pose.sent_counter import SentCounter
from companion.estimation.gate.pose_gate import Sending
from companion.estimation.gate.pose_journal import JournaledPoseGate
from companion.estimation.gate.pose_to_send import PoseToSend
from companion.estimation.gate.proof import MAP_RESUMED
from companion.estimation.gate.reset_counter import ResetCounter
from companion.flight_notes import GateStep
from companion.health import FeedbackHealth
from companion.messages import Odometry, Warned
from companion.meters import LatencyMeter, RateMeter
from companion.pilot_messages import (
    DEAD_RECKONING,
    POSITION_ON,
    PilotText,
    no_position,
    position_lost,
)
from companion.telemetry import AttitudeSample
from companion.timing.clock import FlightClock
from drivers.mavlink.autopilot_height import AutopilotHeight
from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.mavlink.measurements.pose_messages import pose_messages
from drivers.system.ticks import tick

TICK_S, IDLE_TICK_S = 0.002, 0.05
"""Between two polls of the gate."""
TOLD_AFTER_NS = 1_000_000_000
"""Dead reckoning for longer is told to the pilot; single frames are not tracked now and then."""
ALOFT = (POSITION_ON(), DEAD_RECKONING())
"""Last texts while poses are sent."""
UNHEARD = "the autopilot is silent"
SWITCHED_OFF = "switched off"
LINK_TOO_SLOW = "the link is too slow"
OTHER_COMPANION = "another companion on the link"
SAY_WHY_AFTER_NS, SAY_WHY_EVERY_NS = 30_000_000_000, 60_000_000_000
"""Without a pose for the first, the pilot is told why, and again after the second."""


class PoseSender(Sender):
    """Odometry of the current flight in; ODOMETRY or VISION_POSITION_ESTIMATE out, or nothing.

    The file at `counter_path` keeps the reset counter sent, for the next process. `journal` takes
    what the gate was asked.
    """

    name = "feedback"

    def __init__(
        self,
        config: FeedbackConfig,
        camera_hz: float,
        link: AutopilotLink,
        clock: FlightClock,
        counter_path: Path,
        warn: Callable[[Warned], None],
        journal: Callable[[GateStep], None],
    ) -> None:
        self._config, self._link, self._clock = config, link, clock
        self._camera_hz = camera_hz
        counter, height = ResetCounter(), AutopilotHeight(link)
        self._counter = SentCounter(counter_path, counter, height, link, clock, warn)
        self._gate = JournaledPoseGate(
            config,
            counter,
            height.down_m,
            self._may_start,
            clock.now_ns,
            lambda: link.alive,
            journal,
        )
        self._rate, self._latency = RateMeter(), LatencyMeter()
        self._n_sent = 0
        self._heard_other = self._yields = False
        self._told: PilotText | None = None
        self._not_sent_since_ns: int | None = None
        self._said_why_ns = 0
        link.sends_poses = config.mode != "off"
        self._bridging_since_ns: int | None = None
        self.takes = {
            AttitudeSample: self.take_attitude, Odometry: self.take, Warned: self.take_warning,
        }  # fmt: skip

    def _may_start(self, now_ns: int) -> str:
        """Reason why no first pose of a sequence may be sent now; "" if it may."""
        if self._yields:
            return OTHER_COMPANION
        if not self._link.carries(self._config, self._camera_hz):
            return LINK_TOO_SLOW
        return self._counter.may_start(now_ns)

    def _look_for_another(self, now_ns: int) -> None:
        """Yield to another companion, unless poses were sent before it came."""
        vehicle = self._link.vehicle
        armed = vehicle is not None and vehicle.armed
        heard = self._link.other_companion.is_heard(now_ns, armed)
        if heard and not self._heard_other:
            self._yields = not self._gate.sending
        self._heard_other = heard
        self._yields &= heard

    def restart(self) -> None:
        """Begin anew with another localisation."""
        self._gate.restart()

    def begin_flight(self, use: Collection[Measurement]) -> None:
        """Begin anew with another flight, of whose telemetry is believed what is in `use`."""
        self._gate.begin(use)

    def reconfigure(self, config: FeedbackConfig) -> None:
        """Apply another configuration, from the next message on."""
        self._config = config
        self._link.sends_poses = config.mode != "off"
        self._gate.reconfigure(config)
        if config.mode == "off":
            self._gate.withhold(SWITCHED_OFF)
            self._tell()

    def take_attitude(self, sample: AttitudeSample) -> None:
        """Take an attitude of the autopilot."""
        self._gate.take_attitude(sample)

    def take_warning(self, warning: Warned) -> None:
        """Take what localisation tells of its map."""
        if warning.what == MAP_RESUMED:
            self._gate.map_resumed()

    def take(self, odometry: Odometry) -> None:
        """Take the odometry of a frame, and send it if the gate allows."""
        if self._config.mode == "off":
            return
        self._counter.step(self._gate)
        self._look_for_another(self._clock.now_ns())
        self._send(self._gate.take(odometry, self._clock.now_ns()))
        self._tell()

    async def run(self) -> None:
        """Send predicted poses when due, and report when poses cease; until cancelled."""
        while True:
            due_ns = self._gate.due_ns
            wait_s = IDLE_TICK_S
            if due_ns is not None:  # a frame that comes meanwhile only puts it off
                wait_s = max(1e-9 * (due_ns - self._clock.now_ns()), TICK_S)
            await (asyncio.sleep(wait_s) if wait_s < IDLE_TICK_S else tick(IDLE_TICK_S))
            self.step()

    def step(self) -> None:
        """Send a predicted pose if one is due; to be called when it is."""
        self._counter.step(self._gate)
        self._look_for_another(self._clock.now_ns())
        if self._config.mode != "off" or self._told in ALOFT:
            self._send(self._gate.due(self._clock.now_ns()))
            self._tell()

    def health(self) -> FeedbackHealth:
        """Health of the feedback now."""
        if self._config.mode == "off":
            return FeedbackHealth(n_resets=self._gate.n_resets)
        now_ns = self._clock.now_ns()
        p50_ms, p95_ms = self._latency.percentiles_ms((50, 95), now_ns)
        return FeedbackHealth(
            mode=self._config.mode,
            sending=self._gate.sending and self._link.alive,
            bridging=self._gate.state is Sending.BRIDGING,
            why_not=self._gate.why_not or ("" if self._link.alive else UNHEARD),
            rate_hz=self._rate.hz(now_ns),
            latency_p50_ms=p50_ms,
            latency_p95_ms=p95_ms,
            n_sent=self._n_sent,
            n_resets=self._gate.n_resets,
            n_overtaken=self._gate.n_overtaken,
        )

    def _send(self, pose: PoseToSend | None) -> None:
        vehicle = self._link.vehicle
        if pose is None or vehicle is None or not self._link.alive:
            return
        for message in pose_messages(pose, self._config.mode, vehicle.firmware):
            self._link.send(message)
        now_ns = self._clock.now_ns()
        self._n_sent += 1
        self._rate.add(now_ns)
        if not pose.predicted:
            self._latency.add(now_ns, (now_ns - pose.t_ns) * 1e-6)

    def _tell(self) -> None:
        """Tell the pilot when poses begin and cease, and when they go by dead reckoning."""
        state, now_ns = self._gate.state, self._clock.now_ns()
        self._tell_why(now_ns)
        if state is not Sending.BRIDGING:
            self._bridging_since_ns = None
        elif self._bridging_since_ns is None:
            self._bridging_since_ns = now_ns
        if state is Sending.SENDING:
            text = POSITION_ON()
        elif self._bridging_since_ns is not None:
            if now_ns - self._bridging_since_ns < TOLD_AFTER_NS:
                return
            text = DEAD_RECKONING()
        elif self._told in ALOFT:
            text = position_lost(self._gate.why_not)
        else:
            return
        if text != self._told and self._link.say(text):  # else it is tried again
            self._told = text

    def _tell_why(self, now_ns: int) -> None:
        """Tell the pilot now and then why there is no pose, where there was none for long."""
        if self._gate.sending or self._config.mode == "off" or not self._link.alive:
            self._not_sent_since_ns = None
            return
        if self._not_sent_since_ns is None:
            self._not_sent_since_ns = now_ns
        long = now_ns - self._not_sent_since_ns >= SAY_WHY_AFTER_NS
        if long and now_ns - self._said_why_ns >= SAY_WHY_EVERY_NS:
            if self._link.say(no_position(self._gate.why_not)):
                self._said_why_ns = now_ns
