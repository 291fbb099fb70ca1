"""Missions between a trial's ground station and the vehicle, by MAVLink's mission protocol."""

from __future__ import annotations

import time
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.firmware.ground import AUTOPILOT, COMPANION, Ground

ANSWER_S, TRIES = 1.0, 5
UPLOAD_S = 20.0
ASKED = "MISSION_REQUEST_INT", "MISSION_REQUEST"


def fetched(ground: Ground) -> list[Any]:
    """Items of the companion's mission; empty where it has none, or does not answer."""
    kind = mavlink.MAV_MISSION_TYPE_MISSION
    count = _asked(
        ground, mavlink.MAVLink_mission_request_list_message(*COMPANION, kind), "MISSION_COUNT"
    )
    items = []
    for number in range(count.count if count is not None else 0):
        ask = mavlink.MAVLink_mission_request_int_message(*COMPANION, number, kind)
        item = _asked(ground, ask, "MISSION_ITEM_INT", number)
        if item is None:
            return []
        items.append(item)
    return items


def uploaded(ground: Ground, items: list[Any]) -> bool:
    """Whether the autopilot took them for its mission."""
    kind, began_s = mavlink.MAV_MISSION_TYPE_MISSION, time.time()
    ground.send(mavlink.MAVLink_mission_count_message(*AUTOPILOT, len(items), kind))
    answered_s = began_s
    while time.time() - began_s < UPLOAD_S:
        if ground.came_s.get("MISSION_ACK", 0.0) >= began_s:
            return int(ground.latest["MISSION_ACK"].type) == int(mavlink.MAV_MISSION_ACCEPTED)
        for name in ASKED:
            if ground.came_s.get(name, 0.0) > answered_s:
                answered_s = ground.came_s[name]
                ground.send(_for_autopilot(items[ground.latest[name].seq]))
        time.sleep(0.005)
    return False


def _for_autopilot(item: Any) -> Any:
    return mavlink.MAVLink_mission_item_int_message(
        *AUTOPILOT, item.seq, item.frame, item.command, 0, 1, item.param1, item.param2,
        item.param3, item.param4, item.x, item.y, item.z, mavlink.MAV_MISSION_TYPE_MISSION,
    )  # fmt: skip


def _asked(ground: Ground, question: Any, name: str, number: int | None = None) -> Any:
    """The companion's answer, None without one."""
    key = f"COMPANION/{name}"

    def answers() -> bool:
        came = ground.came_s.get(key, 0.0) >= began_s
        return came and (number is None or ground.latest[key].seq == number)

    for _ in range(TRIES):
        began_s = time.time()
        ground.send(question)
        if ground.until(answers, ANSWER_S):
            return ground.latest[key]
    return None
