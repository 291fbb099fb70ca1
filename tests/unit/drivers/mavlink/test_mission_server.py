"""Mission protocol of our component: what is given, what is refused, and to how many."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.geometry.transforms import Array
from drivers.mavlink.ground.mission_server import MOST_ASKERS, MOST_WAITING, MissionServer
from tests.support.autopilot.ground_station import asked

OURS = (1, 197)
FENCE, RALLY, EVERY = (
    mavlink.MAV_MISSION_TYPE_FENCE, mavlink.MAV_MISSION_TYPE_RALLY, mavlink.MAV_MISSION_TYPE_ALL,
)  # fmt: skip


class Served:
    def __init__(self) -> None:
        self.mission: Array = np.array([[47.1, 8.2, 500.0], [-47.123456789, -180.0, 12.5]])
        self.server = MissionServer(lambda: self.mission)

    def ask(self, message: Any, asker: int = 255, to_all: bool = False) -> Any:
        """The answer; None without one."""
        self.server.take(asked(message, asker, 190), to_all)
        answer = self.server.next_message()
        assert self.server.next_message() is None
        return None if answer is None else asked(answer, *OURS)

    def list(self, asker: int = 255) -> int:
        answer = self.ask(mavlink.MAVLink_mission_request_list_message(*OURS), asker)
        assert (answer.get_type(), answer.target_system) == ("MISSION_COUNT", asker)
        return int(answer.count)

    def item(self, seq: int, asker: int = 255) -> Any:
        return self.ask(mavlink.MAVLink_mission_request_int_message(*OURS, seq), asker)


def test_a_mission_is_given_as_it_was_when_it_was_asked_for() -> None:
    served = Served()
    assert served.list() == 2
    served.mission = np.array([[1.0, 2.0, 3.0]])
    item = served.item(1)
    assert (item.x, item.y, item.z) == (-471234568, -1800000000, 12.5)
    assert (item.seq, item.frame, item.command) == (1, mavlink.MAV_FRAME_GLOBAL_INT, 16)
    assert math.isnan(item.param4) and (item.autocontinue, item.current) == (1, 0)
    old = served.ask(mavlink.MAVLink_mission_request_message(*OURS, 0))
    assert (old.get_type(), old.x) == ("MISSION_ITEM_INT", 471000000)
    assert served.list(asker=254) == 1
    assert served.item(0).x == 471000000
    assert served.item(0, asker=254).x == 10000000
    assert served.list() == 1


def test_none_is_an_empty_mission() -> None:
    served = Served()
    served.mission = np.empty((0, 3))
    assert served.list() == 0
    assert served.item(0).type == mavlink.MAV_MISSION_INVALID_SEQUENCE


def test_what_was_not_listed_or_is_beyond_the_end_is_an_error() -> None:
    served = Served()
    assert served.item(0).type == mavlink.MAV_MISSION_ERROR
    served.list()
    assert served.item(65535).type == mavlink.MAV_MISSION_INVALID_SEQUENCE
    assert served.item(0).get_type() == "MISSION_ITEM_INT"


@pytest.mark.parametrize(
    "message",
    [
        mavlink.MAVLink_mission_count_message(*OURS, 3),
        mavlink.MAVLink_mission_count_message(*OURS, 3, FENCE),
        mavlink.MAVLink_mission_clear_all_message(*OURS),
        mavlink.MAVLink_mission_clear_all_message(*OURS, EVERY),
        mavlink.MAVLink_mission_write_partial_list_message(*OURS, 0, 1),
        mavlink.MAVLink_mission_request_partial_list_message(*OURS, 0, 1),
        mavlink.MAVLink_mission_request_list_message(*OURS, FENCE),
        mavlink.MAVLink_mission_request_list_message(*OURS, RALLY),
        mavlink.MAVLink_mission_request_int_message(*OURS, 0, RALLY),
    ],
    ids=lambda message: f"{message.get_type()}-{message.mission_type}",
)
def test_nobody_changes_it_and_there_is_no_other_plan(message: Any) -> None:
    served = Served()
    served.list()
    answer = served.ask(message)
    assert (answer.get_type(), answer.type) == ("MISSION_ACK", mavlink.MAV_MISSION_UNSUPPORTED)
    assert answer.mission_type == message.mission_type
    assert served.item(0).get_type() == "MISSION_ITEM_INT"
    assert served.ask(message, to_all=True) is None


def test_of_many_askers_the_newest_are_answered() -> None:
    served = Served()
    for asker in range(1, MOST_ASKERS + 2):
        served.list(asker)
    assert served.item(0, 1).type == mavlink.MAV_MISSION_ERROR
    assert served.item(0, 2).get_type() == "MISSION_ITEM_INT"
    for asker in range(1, 200):
        message = mavlink.MAVLink_mission_request_int_message(*OURS, 0)
        served.server.take(asked(message, asker, 190), False)
    n = 0
    while served.server.next_message() is not None:
        n += 1
    assert n == MOST_WAITING
