"""Parameter protocol of our component."""

from __future__ import annotations

import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drivers.mavlink.ground.parameter_server import (
    NOT_NOW,
    OUT_OF_RANGE,
    SET,
    UNKNOWN,
    ParameterServer,
)
from tests.support.autopilot.ground_station import asked

INT32, REAL32 = mavlink.MAV_PARAM_TYPE_INT32, mavlink.MAV_PARAM_TYPE_REAL32


class Values:
    """Three parameters; the last cannot be set now."""

    def __init__(self) -> None:
        self.values = {"FIRST": 1.5, "SIXTEEN_LETTERS_": 2.0, "FIXED": 3.0}

    @property
    def names(self) -> list[str]:
        return list(self.values)

    def value(self, name: str) -> float:
        return self.values[name]

    def set(self, name: str, value: float) -> int:
        if name == "FIXED":
            return NOT_NOW
        if not 0 <= value <= 10:
            return OUT_OF_RANGE
        self.values[name] = value
        return SET


class Served:
    def __init__(self) -> None:
        self.values = Values()
        self.server = ParameterServer(self.values)

    def take(self, message: Any) -> list[Any]:
        """All that is then said."""
        self.server.take(asked(message, 255, 190), message.target_component == 0)
        out = []
        while (answer := self.server.next_message()) is not None:
            out.append(answer)
        return out

    def set(self, name: str, value: float, kind: int = REAL32, component: int = 197) -> list[Any]:
        message = mavlink.MAVLink_param_set_message(1, component, name.encode(), value, kind)
        return self.take(message)

    def read(self, name: str = "", number: int = -1, component: int = 197) -> list[Any]:
        message = mavlink.MAVLink_param_request_read_message(1, component, name.encode(), number)
        return self.take(message)


@pytest.fixture
def served() -> Served:
    return Served()


def told(message: Any) -> tuple[str, float, int]:
    name = message.param_id
    return (
        name if isinstance(name, str) else name.decode(),
        message.param_value,
        message.param_index,
    )


@pytest.mark.parametrize("component", [197, 0])
def test_the_list_is_all_of_them(served: Served, component: int) -> None:
    out = served.take(mavlink.MAVLink_param_request_list_message(1, component))
    assert [told(each) for each in out] == [
        ("FIRST", 1.5, 0), ("SIXTEEN_LETTERS_", 2.0, 1), ("FIXED", 3.0, 2),
    ]  # fmt: skip
    assert {(each.param_count, each.param_type) for each in out} == {(3, REAL32)}


def test_one_is_read_by_name_or_number(served: Served) -> None:
    (by_name,) = served.read("SIXTEEN_LETTERS_")
    (by_number,) = served.read(number=1)
    assert told(by_name) == told(by_number) == ("SIXTEEN_LETTERS_", 2.0, 1)


@pytest.mark.parametrize("asked_for", [{"name": "NONE"}, {"number": 3}, {"number": 32767}])
def test_what_is_not_there_is_an_error(served: Served, asked_for: dict[str, Any]) -> None:
    (error,) = served.read(**asked_for)
    assert error.get_type() == "PARAM_ERROR" and error.error == UNKNOWN
    assert (error.target_system, error.target_component) == (255, 190)
    assert served.read(**asked_for, component=0) == []


def test_what_is_set_is_said(served: Served) -> None:
    (value,) = served.set("FIRST", 2.5)
    assert told(value) == ("FIRST", 2.5, 0)
    assert served.values.values["FIRST"] == 2.5


@pytest.mark.parametrize(
    ("name", "value", "kind", "error"),
    [
        ("FIRST", 11.0, REAL32, OUT_OF_RANGE), ("FIRST", math.nan, REAL32, OUT_OF_RANGE),
        ("FIRST", 2.0, INT32, OUT_OF_RANGE), ("FIXED", 2.0, REAL32, NOT_NOW),
    ],
)  # fmt: skip
def test_what_cannot_be_set_is_said_as_it_was(
    served: Served, name: str, value: float, kind: int, error: int
) -> None:
    before = dict(served.values.values)
    said_value, said_error = served.set(name, value, kind)
    assert told(said_value)[:2] == (name, before[name])
    assert said_error.get_type() == "PARAM_ERROR" and said_error.error == error
    assert served.values.values == before


def test_setting_is_for_us_alone(served: Served) -> None:
    assert served.set("FIRST", 2.5, component=0) == []
    assert served.values.values["FIRST"] == 1.5


def test_a_storm_of_requests_takes_little_memory(served: Served) -> None:
    message = mavlink.MAVLink_param_request_list_message(1, 197)
    wrong = mavlink.MAVLink_param_request_read_message(1, 197, b"NONE", -1)
    for _ in range(1000):
        served.server.take(asked(message, 255, 190), False)
        served.server.take(asked(wrong, 255, 190), False)
    assert len(served.take(message)) < 30
