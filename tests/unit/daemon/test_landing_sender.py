"""Landing targets sent to an autopilot on a link without a wire, and what is not sent."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.app.replay.sent_again import SentAgain
from companion.config import MEASUREMENTS, Config, LandingConfig
from companion.daemon.pose.landing_sender import NO_POSITION, UNHEARD, LandingSender
from companion.estimation.gate.gate_journal import LANDING
from companion.estimation.landing.landing_gate import STALE
from companion.estimation.landing.marker_detector import NOT_SEEN
from companion.flight_notes import GateStep
from companion.geometry.transforms import quaternion_from_euler
from companion.messages import LandingTarget
from companion.telemetry import AttitudeSample, Telemetry
from drivers.recording.decisions import Decisions, payloads_of
from tests.support.autopilot.memory_link import SetClock, listen, memory_link
from tests.support.autopilot.memory_port import MemoryPort
from tests.support.flights.recorded_steps import recorded

MS = 1_000_000
LATENCY_NS = 50 * MS
HEADING_RAD = 0.5 * np.pi
BELOW = np.array([0.5, 0.1, 4.0])
MARKER = LandingConfig("apriltag_36h11", 0, 0.4)
VELOCITY = np.array([1.0, 0.0, 0.5])


class Vehicle:
    """Heading east, level, drifting north and down; an image each 40 ms, positions at 10 Hz."""

    def __init__(self, autopilot: int) -> None:
        self.clock, self.port, self.autopilot = SetClock(), MemoryPort(), autopilot
        self.began_ns = self.clock.t_ns
        self.link = memory_link(self.port, self.clock, self._deliver)
        self.steps: list[GateStep] = []
        self.attitudes: list[AttitudeSample] = []
        self.targets: dict[int, LandingTarget] = {}
        self.sender = LandingSender(MARKER, self.link, self.clock, MEASUREMENTS, self.steps.append)
        self.positions = True
        asyncio.run(listen(self.link))

    def _deliver(self, sample: Telemetry) -> None:
        pass

    def position(self, t_ns: int) -> Any:
        return np.array([3.0, 4.0, -4.0]) + VELOCITY * 1e-9 * (t_ns - self.began_ns)

    def run(self, seconds: float, seen: bool = True, late_ns: int = LATENCY_NS) -> list[Any]:
        n_before = len(self.sent)
        for _ in range(round(seconds * 50)):
            self.clock.t_ns += 20 * MS
            now_ns = self.clock.t_ns
            level = quaternion_from_euler(0.0, 0.0, HEADING_RAD)
            self.attitudes.append(AttitudeSample(now_ns, level, np.zeros(3)))
            self.sender.take_attitude(self.attitudes[-1])
            boot_ms = (now_ns - self.began_ns) // MS + 10_000
            if now_ns % (100 * MS) == 0:
                self.port.hear(
                    mavlink.MAVLink_heartbeat_message(2, self.autopilot, 0, 0, 4, 3), now_ns
                )
                if self.positions:
                    self.port.hear(
                        mavlink.MAVLink_local_position_ned_message(
                            boot_ms, *self.position(now_ns), *VELOCITY
                        ),
                        now_ns,
                    )
            if now_ns % (40 * MS) == 0:
                self.sender.take(self.target(now_ns - late_ns, seen))
        return self.sent[n_before:]

    def target(self, t_ns: int, seen: bool) -> LandingTarget:
        seq, up = len(self.targets), np.array([[0.0, 0.0, -1.0]])
        self.targets[seq] = (
            LandingTarget(seq, t_ns, BELOW, np.full(3, 0.01), up, 50.0)
            if seen
            else LandingTarget(seq, t_ns, why_not=NOT_SEEN)
        )
        return self.targets[seq]

    @property
    def sent(self) -> list[Any]:
        return self.port.of("LANDING_TARGET")

    @property
    def texts(self) -> list[str]:
        return [str(each.text) for each in self.port.of("STATUSTEXT")]


def ardupilot() -> Vehicle:
    return Vehicle(mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA)


def px4() -> Vehicle:
    return Vehicle(mavlink.MAV_AUTOPILOT_PX4)


def test_ardupilot_gets_it_from_the_body_with_the_time_of_the_image() -> None:
    vehicle = ardupilot()
    messages = vehicle.run(1.0)
    assert len(messages) >= 20
    last = messages[-1]
    assert (last.frame, last.position_valid) == (mavlink.MAV_FRAME_BODY_FRD, 1)
    assert [last.x, last.y, last.z] == pytest.approx(BELOW)
    assert last.distance == pytest.approx(float(np.linalg.norm(BELOW)))
    # what a firmware makes of the angles (AC_PrecLand): (-tan y, tan x, 1)
    assert [-np.tan(last.angle_y), np.tan(last.angle_x)] == pytest.approx(BELOW[:2] / BELOW[2])
    sent_ns = vehicle.clock.t_ns - vehicle.clock.t_ns % (40 * MS)
    assert last.time_usec == (sent_ns - LATENCY_NS) // 1000
    health = vehicle.sender.health()
    assert health.sending and health.why_not == ""
    assert health.latency_p50_ms == pytest.approx(50)
    assert vehicle.texts == ["Companion: landing marker in sight"]


def test_px4_gets_it_about_its_own_position_at_the_time_of_the_image() -> None:
    vehicle = px4()
    last = vehicle.run(1.0)[-1]
    assert (last.frame, last.position_valid) == (mavlink.MAV_FRAME_LOCAL_NED, 1)
    at_image = vehicle.position(last.time_usec * 1000)
    # heading east: forward is east, right is south
    placed = at_image + [-BELOW[1], BELOW[0], BELOW[2]]
    assert [last.x, last.y, last.z] == pytest.approx(placed, abs=0.002)


def test_px4_gets_nothing_without_its_own_position() -> None:
    vehicle = px4()
    vehicle.run(1.0)
    vehicle.positions = False
    vehicle.run(0.5)
    assert vehicle.run(0.5) == []
    assert vehicle.sender.health().why_not == NO_POSITION


def test_nothing_is_sent_too_late_to_a_silent_autopilot_or_without_a_marker() -> None:
    vehicle = ardupilot()
    assert vehicle.run(0.5, late_ns=250 * MS) == []
    assert vehicle.sender.health().why_not == STALE
    assert vehicle.run(0.5) != []
    assert vehicle.run(0.5, seen=False) == []
    assert vehicle.sender.health().why_not == NOT_SEEN
    vehicle.run(1.0, seen=False)
    assert not vehicle.sender.health().sending
    assert vehicle.texts[-1] == "Companion: landing marker lost"
    vehicle.port.hear(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3), vehicle.clock.t_ns)
    vehicle.run(0.05)
    vehicle.link.alive = False  # as its watch finds after three seconds
    t_ns = vehicle.clock.t_ns
    for n in range(4):
        vehicle.sender.take(vehicle.target(t_ns - 40 * MS + n * MS, seen=True))
    assert vehicle.sender.health().why_not == UNHEARD


@pytest.mark.parametrize("vehicle", [ardupilot(), px4()], ids=["ardupilot", "px4"])
def test_its_journal_gives_the_messages_again(vehicle: Vehicle) -> None:
    vehicle.run(0.3)
    vehicle.attitudes.clear()
    n_before = len(vehicle.sent)
    vehicle.sender.begin_flight(MEASUREMENTS)
    vehicle.run(0.5)
    vehicle.positions = False
    vehicle.run(0.6, late_ns=70 * MS)
    vehicle.run(0.3, seen=False)
    vehicle.positions = True
    vehicle.run(0.5)
    told = Decisions(replace(Config(), landing=MARKER), lossless=True)
    told.samples.extend(vehicle.attitudes)
    steps = [recorded(step) for step in vehicle.steps]
    steps = steps[[step.what for step in steps].index("begin") :]
    made = SentAgain(told, {}, vehicle.targets, {}).payloads(steps)
    assert len(vehicle.sent) > n_before + 15
    assert made == {LANDING: payloads_of(vehicle.sent[n_before:])}
