"""EKF source sets switched by the verdict on satellites, on a link without a wire."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.app.replay.sent_again import SentAgain
from companion.config import Config, GpsConfig
from companion.daemon.pose.source_switch import (
    NOT_SWITCHED,
    TO_SATELLITES,
    TO_VISION,
    SourceSwitch,
)
from companion.estimation.gate.gate_journal import SOURCES
from companion.estimation.satellites.source_choice import AGAIN_NS
from companion.flight_notes import GateStep
from companion.messages import Warned
from drivers.recording.decisions import Decisions, payloads_of
from tests.support.autopilot.memory_link import SetClock, listen, memory_link
from tests.support.autopilot.memory_port import MemoryPort
from tests.support.flights.recorded_steps import recorded

SWITCH = mavlink.MAV_CMD_SET_EKF_SOURCE_SET
GPS = GpsConfig(True, 3, 1)


class Vehicle:
    """Answers commands at once, as told."""

    def __init__(self, autopilot: int = mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA) -> None:
        self.clock, self.port = SetClock(), MemoryPort()
        self.link = memory_link(self.port, self.clock, lambda _: None)
        self.warned: list[Warned] = []
        self.steps: list[GateStep] = []
        self.sending, self.result = True, mavlink.MAV_RESULT_ACCEPTED
        self.switch = SourceSwitch(
            GPS, self.link, self.clock, lambda: self.sending, self.warned.append,
            self.steps.append,
        )  # fmt: skip
        self.autopilot = autopilot

    async def begin(self) -> None:
        await listen(self.link)
        self.hear(armed=True)
        self.switch.begin_flight(())

    def hear(self, armed: bool) -> None:
        mode = mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0
        self.port.hear(
            mavlink.MAVLink_heartbeat_message(2, self.autopilot, mode, 0, 4, 3), self.clock.t_ns
        )

    async def step(self) -> None:
        step = asyncio.create_task(self.switch.step())
        n_before = len(self.commands)
        for _ in range(5):
            await asyncio.sleep(0)
            for command in self.commands[n_before:]:
                acknowledgement = mavlink.MAVLink_command_ack_message(command.command, self.result)
                self.port.hear(acknowledgement, self.clock.t_ns)
            n_before = len(self.commands)
        await step
        self.clock.t_ns += 100_000_000

    @property
    def commands(self) -> list[Any]:
        return [each for each in self.port.of("COMMAND_LONG") if each.command == SWITCH]

    @property
    def sets(self) -> list[float]:
        return [each.param1 for each in self.commands]


async def test_it_switches_to_vision_and_back() -> None:
    vehicle = Vehicle()
    await vehicle.begin()
    await vehicle.step()
    assert vehicle.sets == []
    vehicle.switch.doubt_satellites(True)
    await vehicle.step()
    await vehicle.step()
    assert vehicle.sets == [3]
    vehicle.switch.doubt_satellites(False)
    await vehicle.step()
    await vehicle.step()
    assert vehicle.sets == [3, 1]
    assert [each.what for each in vehicle.warned] == [TO_VISION, TO_SATELLITES]


async def test_without_poses_it_waits() -> None:
    """The EKF would be left with nothing to fly on."""
    vehicle = Vehicle()
    await vehicle.begin()
    vehicle.sending = False
    vehicle.switch.doubt_satellites(True)
    await vehicle.step()
    assert vehicle.sets == []
    vehicle.sending = True
    await vehicle.step()
    assert vehicle.sets == [3]


async def test_a_refusal_is_said_and_tried_again_later() -> None:
    vehicle = Vehicle()
    await vehicle.begin()
    vehicle.result = mavlink.MAV_RESULT_UNSUPPORTED
    vehicle.switch.doubt_satellites(True)
    for _ in range(5):
        await vehicle.step()
    assert vehicle.sets == [3]
    assert [each.what for each in vehicle.warned] == [NOT_SWITCHED]
    vehicle.clock.t_ns += AGAIN_NS
    vehicle.result = mavlink.MAV_RESULT_ACCEPTED
    await vehicle.step()
    assert vehicle.sets == [3, 3]
    assert vehicle.warned[-1].what == TO_VISION


@pytest.mark.parametrize("silent", [False, True])
async def test_nothing_for_another_firmware_or_a_silent_one(silent: bool) -> None:
    vehicle = Vehicle(mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA if silent else mavlink.MAV_AUTOPILOT_PX4)
    await vehicle.begin()
    vehicle.link.alive = not silent
    vehicle.switch.doubt_satellites(True)
    await vehicle.step()
    assert vehicle.sets == []


async def test_a_doubt_outlives_its_flight_in_the_air_only() -> None:
    """Another flight's verdict begins anew: nobody would ever take the doubt back."""
    vehicle = Vehicle()
    await vehicle.begin()
    vehicle.switch.doubt_satellites(True)
    await vehicle.step()
    vehicle.switch.begin_flight(())  # localisation has died in the air
    await vehicle.step()
    assert vehicle.sets == [3]
    vehicle.hear(armed=False)
    await vehicle.step()
    assert vehicle.sets == [3, 1]


async def test_another_flight_asks_again_what_its_journal_has() -> None:
    """Also of what the flight before has left: a doubt, and the set that is flown on."""
    vehicle = Vehicle()
    await vehicle.begin()
    vehicle.switch.doubt_satellites(True)
    await vehicle.step()
    vehicle.steps.clear()
    n_before = len(vehicle.commands)
    vehicle.switch.begin_flight(())
    for armed in (True, False, True):
        vehicle.hear(armed)
        await vehicle.step()
    vehicle.result = mavlink.MAV_RESULT_DENIED
    vehicle.switch.doubt_satellites(True)
    await vehicle.step()
    await vehicle.step()
    vehicle.result = mavlink.MAV_RESULT_ACCEPTED
    vehicle.clock.t_ns += AGAIN_NS
    await vehicle.step()
    told = Decisions(replace(Config(), gps=GPS), lossless=True)
    made = SentAgain(told, {}, {}, {}).payloads([recorded(step) for step in vehicle.steps])
    assert vehicle.sets[n_before:] == [1, 3, 3]
    assert made == {SOURCES: payloads_of(vehicle.commands[n_before:])}


async def test_on_the_ground_a_doubt_of_the_flight_that_goes_on_stays() -> None:
    vehicle = Vehicle()
    await vehicle.begin()
    vehicle.hear(armed=False)
    vehicle.switch.doubt_satellites(True)
    for _ in range(3):
        await vehicle.step()
    assert vehicle.sets == [3]


@pytest.mark.parametrize("doubted", [True, False])
async def test_an_autopilot_that_reboots_while_switched_is_told_its_set_again(
    doubted: bool,
) -> None:
    """It has come up with its first set."""
    vehicle = Vehicle()
    await vehicle.begin()
    vehicle.switch.doubt_satellites(True)
    await vehicle.step()
    vehicle.link.clock_filter.n_reboots += 1
    vehicle.switch.doubt_satellites(doubted)
    await vehicle.step()
    await vehicle.step()
    assert vehicle.sets == [3, 3 if doubted else 1]


async def test_an_autopilot_that_reboots_on_its_own_set_is_left_alone() -> None:
    vehicle = Vehicle()
    await vehicle.begin()
    vehicle.link.clock_filter.n_reboots += 1
    await vehicle.step()
    assert vehicle.sets == []


async def test_a_command_without_answer_may_have_been_obeyed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Satellites that agree again before it was answered are to be flown on."""
    vehicle = Vehicle()
    await vehicle.begin()

    async def unanswered(number: int) -> int:
        return -1

    with monkeypatch.context() as patch:
        patch.setattr(vehicle.link.commands, "set_source_set", unanswered)
        vehicle.switch.doubt_satellites(True)
        await vehicle.step()
    vehicle.switch.doubt_satellites(False)
    vehicle.clock.t_ns += AGAIN_NS
    await vehicle.step()
    await vehicle.step()
    assert vehicle.sets == [1]
