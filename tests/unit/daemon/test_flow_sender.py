"""Optical flow sent to an autopilot on a link without a wire, and what is not sent."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.app.replay.sent_again import SentAgain
from companion.config import Config, FeedbackConfig
from companion.daemon.pose.flow_sender import UNHEARD, FlowSender
from companion.estimation.gate.flow_gate import NO_RATES, TOO_OLD
from companion.estimation.gate.gate_journal import FLOW as FLOW_GATE
from companion.estimation.lift_off.optical_flow import NO_ATTITUDE
from companion.flight_notes import GateStep
from companion.messages import OpticalFlow
from companion.telemetry import AttitudeSample, Telemetry
from drivers.recording.decisions import Decisions, payloads_of
from tests.support.autopilot.memory_link import SetClock, listen, memory_link
from tests.support.autopilot.memory_port import MemoryPort
from tests.support.flights.recorded_steps import recorded

MS = 1_000_000
FLOW, DT_S = np.array([0.2, 0.5]), 0.05
LATENCY_NS = 60 * MS


class Vehicle:
    """Sends frames' flow at 20 Hz, and attitudes with a pitch rate that rises, at 50 Hz."""

    def __init__(self, message: Literal["optical_flow", "optical_flow_rad"]) -> None:
        self.clock, self.port = SetClock(), MemoryPort()
        self.steps: list[GateStep] = []
        self.began_ns = self.clock.t_ns
        self.link = memory_link(self.port, self.clock, self._deliver)
        self.sender = FlowSender(
            FeedbackConfig(flow=message), self.link, self.clock, self.steps.append
        )
        self.attitudes: list[AttitudeSample] = []
        self.flows: dict[int, OpticalFlow] = {}
        self.rates_told = True

    async def begin(self) -> None:
        await listen(self.link)

    def _deliver(self, sample: Telemetry) -> None:
        if isinstance(sample, AttitudeSample):
            self.attitudes.append(sample)
            self.sender.take_attitude(sample)

    def pitch_rate(self, t_ns: int) -> float:
        return 2e-9 * (t_ns - self.began_ns)

    def run(self, seconds: float, flow: OpticalFlow | None = None, alive: bool = True) -> list[Any]:
        """The flow messages that were sent."""
        n_before = len(self.sent)
        for _ in range(round(seconds * 100)):
            self.clock.t_ns += 10 * MS
            now_ns = self.clock.t_ns
            if alive and now_ns % (20 * MS) == 0:
                self.port.hear(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3), now_ns)
                if self.rates_told:
                    rates = np.array([0.0, self.pitch_rate(now_ns), 0.0])
                    level = np.array([1.0, 0.0, 0.0, 0.0])
                    self._deliver(AttitudeSample(now_ns, level, rates))
            if now_ns % (50 * MS) == 0:
                seen = replace(self.flow(flow), seq=len(self.flows))
                self.flows[seen.seq] = seen
                self.sender.take(seen)
        return self.sent[n_before:]

    def flow(self, like: OpticalFlow | None) -> OpticalFlow:
        t_ns = self.clock.t_ns - LATENCY_NS
        if like is not None:
            return replace(like, t_ns=t_ns)
        turn = np.array([0.0, self.pitch_rate(t_ns) * DT_S, 0.0])
        return OpticalFlow(1, t_ns, DT_S, FLOW, turn, 0.01, 180)

    @property
    def sent(self) -> list[Any]:
        return self.port.of("OPTICAL_FLOW") + self.port.of("OPTICAL_FLOW_RAD")


def vehicle_of(message: Literal["optical_flow", "optical_flow_rad"]) -> Vehicle:
    vehicle = Vehicle(message)
    asyncio.run(vehicle.begin())
    return vehicle


def test_ardupilot_gets_each_frame_with_the_turn_rate_of_its_arrival() -> None:
    """What its own gyroscopes measured since the message before, not at the frames."""
    vehicle = vehicle_of("optical_flow")
    first, *others = vehicle.run(1.0)
    assert first.quality == 0  # after a pause it would be taken for standing still
    assert len(others) == 19
    last = others[-1]
    assert last.get_type() == "OPTICAL_FLOW"
    assert last.flow_rate_x == pytest.approx(FLOW[0], abs=1e-9)
    middle_ns = vehicle.clock.t_ns - 25 * MS
    # 20 ms between attitudes: the newest is held
    assert last.flow_rate_y == pytest.approx(FLOW[1] + vehicle.pitch_rate(middle_ns), abs=0.02)
    assert last.quality == 180
    health = vehicle.sender.health()
    assert (health.message, health.sending, health.why_not) == ("optical_flow", True, "")
    assert health.rate_hz == pytest.approx(20, abs=1.5)
    assert health.latency_p50_ms == pytest.approx(60, abs=1)


def test_px4_gets_the_turn_of_the_frames() -> None:
    vehicle = vehicle_of("optical_flow_rad")
    messages = vehicle.run(1.0)
    assert len(messages) == 20
    last = messages[-1]
    assert last.get_type() == "OPTICAL_FLOW_RAD"
    turn = vehicle.pitch_rate(vehicle.clock.t_ns - LATENCY_NS) * DT_S
    assert last.integrated_ygyro == pytest.approx(turn)
    assert last.integrated_y == pytest.approx(FLOW[1] * DT_S + turn)
    assert last.integrated_x == pytest.approx(FLOW[0] * DT_S)


def test_without_flow_ardupilot_gets_quality_0_and_px4_nothing() -> None:
    """PX4 believes quality 0 on the ground; ArduPilot needs messages without a pause."""
    nothing = OpticalFlow(1, 0, DT_S, why_not="too little to track")
    ardupilot, px4 = vehicle_of("optical_flow"), vehicle_of("optical_flow_rad")
    assert {each.quality for each in ardupilot.run(0.5, nothing)} == {0}
    assert ardupilot.sender.health().why_not == "too little to track"
    assert px4.run(0.5, nothing) == []
    assert px4.sender.health().why_not == "too little to track"


@pytest.mark.parametrize("message", ["optical_flow", "optical_flow_rad"])
def test_without_attitude_nothing_is_sent(
    message: Literal["optical_flow", "optical_flow_rad"],
) -> None:
    vehicle = vehicle_of(message)
    assert vehicle.run(0.5, OpticalFlow(1, 0, DT_S, why_not=NO_ATTITUDE)) == []
    assert vehicle.sender.health().why_not == NO_ATTITUDE
    assert not vehicle.sender.health().sending


def test_ardupilot_gets_nothing_without_turn_rates() -> None:
    vehicle = vehicle_of("optical_flow")
    vehicle.run(0.5)
    vehicle.rates_told = False
    vehicle.run(0.2)
    assert vehicle.run(0.5) == []
    assert vehicle.sender.health().why_not == NO_RATES


def test_nothing_is_sent_to_a_silent_autopilot_or_too_late() -> None:
    vehicle = vehicle_of("optical_flow_rad")
    vehicle.run(0.5)
    vehicle.link.alive = False  # as its watch finds after three seconds
    assert vehicle.run(0.5, alive=False) == []
    assert vehicle.sender.health().why_not == UNHEARD
    vehicle.run(0.2)
    vehicle.sender.take(OpticalFlow(1, vehicle.clock.t_ns - 400 * MS, DT_S, FLOW, FLOW, 0.01, 99))
    assert vehicle.sender.health().why_not == TOO_OLD


def test_after_a_pause_ardupilot_gets_quality_0_first() -> None:
    vehicle = vehicle_of("optical_flow")
    vehicle.run(1.0)
    vehicle.clock.t_ns += 600 * MS
    assert [each.quality for each in vehicle.run(0.2)] == [0, 180, 180, 180]


def test_switched_off_it_is_silent() -> None:
    vehicle = vehicle_of("optical_flow")
    vehicle.run(0.5)
    vehicle.sender.reconfigure(FeedbackConfig())
    assert vehicle.run(0.5) == []
    assert vehicle.sender.health().message == "off"


@pytest.mark.parametrize("message", ["optical_flow", "optical_flow_rad"])
def test_its_journal_gives_the_messages_again(
    message: Literal["optical_flow", "optical_flow_rad"],
) -> None:
    vehicle = vehicle_of(message)
    vehicle.run(0.3)
    vehicle.attitudes.clear()
    n_before = len(vehicle.sent)
    vehicle.sender.begin_flight(())
    vehicle.run(0.5)
    vehicle.rates_told = False
    vehicle.run(0.6)
    vehicle.rates_told = True
    vehicle.run(0.3)
    vehicle.link.alive = False
    vehicle.run(0.5, alive=False)
    vehicle.run(0.3, OpticalFlow(1, 0, DT_S, why_not="too little to track"))
    vehicle.sender.reconfigure(FeedbackConfig())
    vehicle.run(0.2)
    vehicle.sender.reconfigure(FeedbackConfig(flow=message))
    vehicle.run(0.3)
    feedback = FeedbackConfig(flow=message)
    told = Decisions(replace(Config(), feedback=feedback), lossless=True)
    told.samples.extend(vehicle.attitudes)
    steps = [recorded(step) for step in vehicle.steps]
    steps = steps[[step.what for step in steps].index("begin") :]
    made = SentAgain(told, {}, {}, vehicle.flows).payloads(steps)
    assert len(vehicle.sent) > n_before + 15
    assert made == {FLOW_GATE: payloads_of(vehicle.sent[n_before:])}
