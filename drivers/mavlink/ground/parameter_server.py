"""Parameter protocol, server side: parameters of our component for ground stations.

Messages in, messages out: no clock, no wire. Every parameter is a REAL32, since ground stations
encode integers as the autopilot's firmware does, whatever component they are for (ArduPilot by
value, PX4 by bytes); for a float both are the same. https://mavlink.io/en/services/parameter.html.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any, Protocol

from pymavlink.dialects.v20 import ardupilotmega as mavlink

REAL32: int = mavlink.MAV_PARAM_TYPE_REAL32
SET: int = mavlink.MAV_PARAM_ERROR_NO_ERROR
UNKNOWN: int = mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST
OUT_OF_RANGE: int = mavlink.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE
NOT_NOW: int = mavlink.MAV_PARAM_ERROR_PERMISSION_DENIED
LONGEST_NAME = 16
MOST_ERRORS = 16
"""Limit of waiting errors; of values only one waits for each name."""


class Table(Protocol):
    """Parameters that can be read and set."""

    @property
    def names(self) -> Sequence[str]:
        """Always the same, in order of their indices; at most 16 ASCII characters each."""

    def value(self, name: str) -> float:
        """Value now."""

    def set(self, name: str, value: float) -> int:
        """Set it; SET, or the MAV_PARAM_ERROR for which it is unchanged."""


class ParameterServer:
    """PARAM_REQUEST_LIST, PARAM_REQUEST_READ and PARAM_SET in; PARAM_VALUE and PARAM_ERROR out.

    Answers wait for `next_message`, so that a storm of requests costs the link no more than its
    caller allows.
    """

    def __init__(self, table: Table) -> None:
        self._table = table
        self._numbers = {name: number for number, name in enumerate(table.names)}
        self._soon: dict[str, None] = {}
        self._wanted: dict[str, None] = {}
        self._errors: deque[Any] = deque(maxlen=MOST_ERRORS)

    def take(self, message: Any, to_all: bool) -> None:
        """Take a request; broadcasts are answered only for parameters that exist."""
        kind = message.get_msgId()
        if kind == mavlink.MAVLINK_MSG_ID_PARAM_REQUEST_LIST:
            for name in self._table.names:
                self._wanted[name] = None
            return
        by_number = kind == mavlink.MAVLINK_MSG_ID_PARAM_REQUEST_READ and message.param_index >= 0
        name = self._name(message.param_index) if by_number else str(message.param_id)
        if name not in self._numbers:
            if not to_all:
                self._refuse(message, name, UNKNOWN)
        elif kind == mavlink.MAVLINK_MSG_ID_PARAM_REQUEST_READ:
            self._wanted[name] = None
        elif not to_all:  # a value for every component of that name is for none of ours
            error = OUT_OF_RANGE
            if message.param_type == REAL32:
                error = self._table.set(name, message.param_value)
            if error != SET:
                self._refuse(message, name, error)
            self._soon[name] = None

    def next_message(self) -> Any | None:
        """Next answer; None without one."""
        if self._soon:
            return self._value(self._soon)
        if self._errors:
            return self._errors.popleft()
        return self._value(self._wanted) if self._wanted else None

    def _name(self, number: int) -> str:
        return self._table.names[number] if number < len(self._numbers) else ""

    def _value(self, waiting: dict[str, None]) -> Any:
        name = next(iter(waiting))
        self._soon.pop(name, None)
        self._wanted.pop(name, None)
        return mavlink.MAVLink_param_value_message(
            name.encode("ascii"), self._table.value(name), REAL32, len(self._numbers),
            self._numbers[name],
        )  # fmt: skip

    def _refuse(self, message: Any, name: str, error: int) -> None:
        asker = message.get_srcSystem(), message.get_srcComponent()
        number = self._numbers.get(name, getattr(message, "param_index", -1))
        encoded = name.encode("ascii", "replace")[:LONGEST_NAME]
        self._errors.append(mavlink.MAVLink_param_error_message(*asker, encoded, number, error))
