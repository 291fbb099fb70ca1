"""Mission protocol, server side: one mission of our component, for ground stations to fetch.

Messages in, messages out: no clock, no wire. Nobody can change the mission. What an asker gets is
the mission as it was when he asked for its list, however it changes meanwhile.
https://mavlink.io/en/services/mission.html.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.geometry.transforms import Array

REQUEST_LIST: int = mavlink.MAVLINK_MSG_ID_MISSION_REQUEST_LIST
REQUESTS = (mavlink.MAVLINK_MSG_ID_MISSION_REQUEST_INT, mavlink.MAVLINK_MSG_ID_MISSION_REQUEST)
"""The older of them is answered alike, with MISSION_ITEM_INT."""
REFUSED = (
    mavlink.MAVLINK_MSG_ID_MISSION_COUNT, mavlink.MAVLINK_MSG_ID_MISSION_CLEAR_ALL,
    mavlink.MAVLINK_MSG_ID_MISSION_WRITE_PARTIAL_LIST,
    mavlink.MAVLINK_MSG_ID_MISSION_REQUEST_PARTIAL_LIST,
)  # fmt: skip
MISSIONS = frozenset({REQUEST_LIST, *REQUESTS, *REFUSED})
MOST_ASKERS = 8
"""Downloads at a time; of more the one asked longest ago ends."""
MOST_WAITING = 16
UNSUPPORTED: int = mavlink.MAV_MISSION_UNSUPPORTED
Asker = tuple[int, int]


class MissionServer:
    """MISSION_REQUEST_LIST and MISSION_REQUEST_INT in; MISSION_COUNT and MISSION_ITEM_INT out.

    `mission` gives the waypoints (N, 3) now: latitude and longitude in degrees, height above sea
    level in metres. Answers wait for `next_message`, one for each asker: the newest.
    """

    def __init__(self, mission: Callable[[], Array]) -> None:
        self._mission = mission
        self._fetched: OrderedDict[Asker, Array] = OrderedDict()
        self._waiting: dict[Asker, Any] = {}

    def take(self, message: Any, to_all: bool) -> None:
        """Take a request; broadcasts are left to the autopilot, who has the mission flown."""
        if to_all:
            return
        asker = message.get_srcSystem(), message.get_srcComponent()
        if asker in self._waiting or len(self._waiting) < MOST_WAITING:
            self._waiting[asker] = self._answer(message, asker)

    def next_message(self) -> Any | None:
        """Next answer; None without one."""
        if not self._waiting:
            return None
        return self._waiting.pop(next(iter(self._waiting)))

    def _answer(self, message: Any, asker: Asker) -> Any:
        kind, sort = message.get_msgId(), message.mission_type
        if kind in REFUSED or sort != mavlink.MAV_MISSION_TYPE_MISSION:
            return mavlink.MAVLink_mission_ack_message(*asker, UNSUPPORTED, sort)
        if kind == REQUEST_LIST:
            waypoints = self._fetched[asker] = self._mission()
            self._fetched.move_to_end(asker)
            while len(self._fetched) > MOST_ASKERS:
                self._fetched.popitem(last=False)
            return mavlink.MAVLink_mission_count_message(*asker, len(waypoints), sort)
        if asker not in self._fetched:
            return mavlink.MAVLink_mission_ack_message(*asker, mavlink.MAV_MISSION_ERROR, sort)
        waypoints = self._fetched[asker]
        if message.seq >= len(waypoints):
            return mavlink.MAVLink_mission_ack_message(
                *asker, mavlink.MAV_MISSION_INVALID_SEQUENCE, sort
            )
        return _waypoint(asker, message.seq, waypoints[message.seq])


def _waypoint(asker: Asker, seq: int, place: Array) -> Any:
    """Waypoint without a heading of its own."""
    latitude, longitude = (round(1e7 * float(angle)) for angle in place[:2])
    return mavlink.MAVLink_mission_item_int_message(
        *asker, seq, mavlink.MAV_FRAME_GLOBAL_INT, mavlink.MAV_CMD_NAV_WAYPOINT, 0, 1,
        0.0, 0.0, 0.0, math.nan, latitude, longitude, float(place[2]),
        mavlink.MAV_MISSION_TYPE_MISSION,
    )  # fmt: skip
