"""Messages of our component on request of ground stations, once or at a rate.

The commands: https://mavlink.io/en/services/command.html. A message that is not ours is
UNSUPPORTED, an id of no message DENIED.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drivers.mavlink.component_messages import (
    COMPONENT_INFORMATION_BASIC,
    PROTOCOL_VERSION,
    autopilot_version,
    component_information,
    message_interval,
    protocol_version,
)
from drivers.mavlink.ground.command_server import ACCEPTED, DENIED, UNSUPPORTED, Command, Done

LAST_MESSAGE = 2**24 - 1
DEFAULT_RATE = 0
MOST_HZ = 5.0
"""Highest rate of a message with an adjustable rate."""
HEARTBEAT: int = mavlink.MAVLINK_MSG_ID_HEARTBEAT
COMPUTER_STATUS: int = mavlink.MAVLINK_MSG_ID_ONBOARD_COMPUTER_STATUS
OBSTACLES: int = mavlink.MAVLINK_MSG_ID_OBSTACLE_DISTANCE
OBSTACLES_3D: int = mavlink.MAVLINK_MSG_ID_OBSTACLE_DISTANCE_3D
ODOMETRY: int = mavlink.MAVLINK_MSG_ID_ODOMETRY
VISION_POSITION: int = mavlink.MAVLINK_MSG_ID_VISION_POSITION_ESTIMATE
INTERVAL = mavlink.MAVLINK_MSG_ID_MESSAGE_INTERVAL


class MessageRequests:
    """Handlers of the commands that request messages and set or ask for their rates.

    `now` makes messages of this moment; `rates_hz` gives the rates of all streamed messages;
    `set_rate` changes the rate of an adjustable one, None for its default.
    """

    def __init__(
        self,
        now: Mapping[int, Callable[[], Any]],
        rates_hz: Callable[[], Mapping[int, float]],
        set_rate: Mapping[int, Callable[[float | None], None]],
        boot_ms: Callable[[], int],
    ) -> None:
        self._rates_hz, self._set_rate = rates_hz, set_rate
        self._made: dict[int, Callable[[], Any]] = {
            mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: autopilot_version,
            PROTOCOL_VERSION: protocol_version,
            COMPONENT_INFORMATION_BASIC: lambda: component_information(boot_ms()),
            **now,
        }
        self.commands: dict[int, Command] = {
            mavlink.MAV_CMD_REQUEST_MESSAGE: Command(self._request, only_asks=True),
            mavlink.MAV_CMD_REQUEST_PROTOCOL_VERSION: self._always(protocol_version),
            mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: self._always(autopilot_version),
            mavlink.MAV_CMD_GET_MESSAGE_INTERVAL: Command(self._interval, only_asks=True),
            mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: Command(self._set_interval),
        }

    def _request(self, parameters: Sequence[float]) -> Done:
        number = _whole(parameters[0])
        if number is None:
            return Done(DENIED)
        if number == INTERVAL:
            return self._interval(parameters[1:])
        make = self._made.get(number)
        return Done(UNSUPPORTED) if make is None else Done(ACCEPTED, [make()])

    def _interval(self, parameters: Sequence[float]) -> Done:
        number = _whole(parameters[0])
        if number is None:
            return Done(DENIED)
        return Done(ACCEPTED, [message_interval(number, self._rates_hz().get(number))])

    def _set_interval(self, parameters: Sequence[float]) -> Done:
        number, interval_us = _whole(parameters[0]), parameters[1]
        if number is None or not math.isfinite(interval_us):
            return Done(DENIED)
        take = self._set_rate.get(number)
        if take is None:
            return Done(DENIED if number in self._rates_hz() else UNSUPPORTED)
        if interval_us == DEFAULT_RATE:
            take(None)
        elif interval_us < 0:
            take(0.0)
        elif 1e6 / interval_us > MOST_HZ:
            return Done(DENIED)
        else:
            take(1e6 / interval_us)
        return Done(ACCEPTED)

    @staticmethod
    def _always(make: Callable[[], Any]) -> Command:
        def answer(_parameters: Sequence[float]) -> Done:
            return Done(ACCEPTED, [make()])

        return Command(answer, only_asks=True)


def _whole(value: float) -> int | None:
    """Id of a message; None where invalid."""
    if not math.isfinite(value) or not value.is_integer() or not 0 <= value <= LAST_MESSAGE:
        return None
    return int(value)
