"""The vehicle at the other end of the link, by its HEARTBEAT."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from pymavlink.dialects.v20 import ardupilotmega as mavlink

Firmware = Literal["ardupilot", "px4", "other"]

COPTER_MODES = {
    0: "STABILIZE", 1: "ACRO", 2: "ALT_HOLD", 3: "AUTO", 4: "GUIDED", 5: "LOITER", 6: "RTL",
    7: "CIRCLE", 9: "LAND", 11: "DRIFT", 13: "SPORT", 14: "FLIP", 15: "AUTOTUNE", 16: "POSHOLD",
    17: "BRAKE", 18: "THROW", 19: "AVOID_ADSB", 20: "GUIDED_NOGPS", 21: "SMART_RTL",
    22: "FLOWHOLD", 23: "FOLLOW", 24: "ZIGZAG", 25: "SYSTEMID", 26: "AUTOROTATE", 27: "AUTO_RTL",
}  # fmt: skip
PX4_MODES = {
    1: "MANUAL", 2: "ALTCTL", 3: "POSCTL", 4: "AUTO", 5: "ACRO", 6: "OFFBOARD", 7: "STABILIZED",
    8: "RATTITUDE", 9: "SIMPLE", 10: "TERMINATION",
}  # fmt: skip
PX4_AUTO_MODES = {
    1: "AUTO.READY", 2: "AUTO.TAKEOFF", 3: "AUTO.LOITER", 4: "AUTO.MISSION", 5: "AUTO.RTL",
    6: "AUTO.LAND", 8: "AUTO.FOLLOW", 9: "AUTO.PRECLAND",
}  # fmt: skip
COPTERS = (
    mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_TYPE_COAXIAL, mavlink.MAV_TYPE_HELICOPTER,
    mavlink.MAV_TYPE_HEXAROTOR, mavlink.MAV_TYPE_OCTOROTOR, mavlink.MAV_TYPE_TRICOPTER,
    mavlink.MAV_TYPE_DODECAROTOR,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Vehicle:
    """The vehicle we are on, by its last HEARTBEAT."""

    system_id: int
    firmware: Firmware
    armed: bool
    mode: str
    """In words; the number of an unknown mode."""

    def __str__(self) -> str:
        names = {"ardupilot": "ArduPilot", "px4": "PX4", "other": "autopilot"}
        return f"{names[self.firmware]}, system {self.system_id}"


def is_autopilot(heartbeat: Any) -> bool:
    """True if a HEARTBEAT is of an autopilot, not of a ground station or a camera."""
    return bool(
        heartbeat.get_srcComponent() == mavlink.MAV_COMP_ID_AUTOPILOT1
        and heartbeat.autopilot != mavlink.MAV_AUTOPILOT_INVALID
        and heartbeat.type != mavlink.MAV_TYPE_GCS
    )


def vehicle_of(heartbeat: Any) -> Vehicle:
    """Vehicle by the HEARTBEAT of an autopilot."""
    firmwares: dict[int, Firmware] = {
        mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: "ardupilot",
        mavlink.MAV_AUTOPILOT_PX4: "px4",
    }
    firmware = firmwares.get(heartbeat.autopilot, "other")
    armed = bool(heartbeat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
    mode = _mode(firmware, heartbeat.type, heartbeat.custom_mode)
    return Vehicle(heartbeat.get_srcSystem(), firmware, armed, mode)


def _mode(firmware: Firmware, kind: int, number: int) -> str:
    if firmware == "px4":
        main, sub = number >> 16 & 0xFF, number >> 24
        word = PX4_AUTO_MODES.get(sub) if main == 4 else None
        return word or PX4_MODES.get(main, str(number))
    if firmware == "ardupilot" and kind in COPTERS:
        return COPTER_MODES.get(number, str(number))
    return str(number)
