"""Message requests of ground stations: single messages, and their intervals."""

from __future__ import annotations

import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drivers.mavlink.ground.command_server import ACCEPTED, DENIED, UNSUPPORTED, Done
from drivers.mavlink.message_requests import COMPUTER_STATUS, HEARTBEAT, MessageRequests

CAMERA_INFORMATION = 259
REQUEST, GET, SET = (
    mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAV_CMD_GET_MESSAGE_INTERVAL,
    mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
)  # fmt: skip


class Asked:
    def __init__(self) -> None:
        self.rate_hz: float | None = 1.0
        self.requests = MessageRequests(
            {HEARTBEAT: lambda: mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)},
            lambda: {HEARTBEAT: 1.0, COMPUTER_STATUS: self.rate_hz or 0.0},
            {COMPUTER_STATUS: self._set},
            lambda: 5,
        )

    def _set(self, rate_hz: float | None) -> None:
        self.rate_hz = rate_hz

    def __call__(self, number: int, *parameters: float) -> Done:
        outcome = self.requests.commands[number].handler([*parameters, *[0.0] * 7][:7])
        assert isinstance(outcome, Done)
        return outcome


@pytest.fixture
def ask() -> Asked:
    return Asked()


@pytest.mark.parametrize(
    ("number", "kind"),
    [(0, "HEARTBEAT"), (148, "AUTOPILOT_VERSION"), (300, "PROTOCOL_VERSION"),
     (396, "COMPONENT_INFORMATION_BASIC")],
)  # fmt: skip
def test_a_message_is_asked_for(ask: Asked, number: int, kind: str) -> None:
    done = ask(REQUEST, float(number))
    assert (done.result, [each.get_type() for each in done.messages]) == (ACCEPTED, [kind])


@pytest.mark.parametrize(
    ("command", "kind"),
    [(mavlink.MAV_CMD_REQUEST_PROTOCOL_VERSION, "PROTOCOL_VERSION"),
     (mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, "AUTOPILOT_VERSION")],
)  # fmt: skip
def test_older_questions(ask: Asked, command: int, kind: str) -> None:
    done = ask(command, 1.0)
    assert (done.result, [each.get_type() for each in done.messages]) == (ACCEPTED, [kind])


def test_what_is_none_of_ours(ask: Asked) -> None:
    assert ask(REQUEST, float(CAMERA_INFORMATION)).result == UNSUPPORTED
    assert ask(SET, float(CAMERA_INFORMATION), 1e6).result == UNSUPPORTED
    assert ask(SET, float(HEARTBEAT), 1e6).result == DENIED


@pytest.mark.parametrize("number", [math.nan, -1.0, 0.5, 2.0**24, math.inf])
def test_what_is_no_message(ask: Asked, number: float) -> None:
    assert {ask(command, number).result for command in (REQUEST, GET, SET)} == {DENIED}


@pytest.mark.parametrize(
    ("interval_us", "result", "rate_hz"),
    [(500_000.0, ACCEPTED, 2.0), (0.0, ACCEPTED, None), (-1.0, ACCEPTED, 0.0),
     (1000.0, DENIED, 1.0), (math.nan, DENIED, 1.0), (math.inf, DENIED, 1.0)],
)  # fmt: skip
def test_a_rate(ask: Asked, interval_us: float, result: int, rate_hz: float | None) -> None:
    assert ask(SET, float(COMPUTER_STATUS), interval_us).result == result
    assert ask.rate_hz == rate_hz


def interval_of(done: Done) -> Any:
    (message,) = done.messages
    return message.message_id, message.interval_us


def test_how_often_a_message_comes(ask: Asked) -> None:
    assert interval_of(ask(GET, float(HEARTBEAT))) == (HEARTBEAT, 1_000_000)
    assert interval_of(ask(REQUEST, 244.0, float(HEARTBEAT))) == (HEARTBEAT, 1_000_000)
    assert interval_of(ask(GET, float(CAMERA_INFORMATION))) == (CAMERA_INFORMATION, 0)
    ask(SET, float(COMPUTER_STATUS), -1.0)
    assert interval_of(ask(GET, float(COMPUTER_STATUS))) == (COMPUTER_STATUS, -1)
