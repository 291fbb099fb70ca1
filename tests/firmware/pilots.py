"""Commands of a trial, in each firmware's own way: arm, take off, go, turn, land.

Places are in the autopilot's own frame, local NED, metres. Sticks stay centred, as with a pilot who
only watches.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.geometry.transforms import Array
from tests.firmware.ground import CENTRED, THROTTLE_LOW, Ground
from tests.firmware.simulators import Px4, Simulator

PLACE, PLACE_AND_YAW, PLACE_SPEED_AND_YAW = 0b110111111000, 0b100111111000, 0b100111000000
"""What of SET_POSITION_TARGET_LOCAL_NED is not to be ignored."""
FORCED = 21196
SET_EKF_SOURCE_SET = 42007
ACK_S = 2.0
PX4_SPEED_M_S = 2.0
"""Told a place far away, PX4 tilts by 45 degrees, and the camera looks at the horizon: so the place
that it is told moves there."""
SET_TIMES = 3
"""Over UDP, without waiting for its answer."""
COPTER_MODES = {
    "STABILIZE": 0, "ALT_HOLD": 2, "AUTO": 3, "GUIDED": 4, "LOITER": 5, "LAND": 9, "BRAKE": 17,
}  # fmt: skip
PX4_MAIN = {"MANUAL": 1, "ALTCTL": 2, "POSCTL": 3, "AUTO": 4, "ACRO": 5, "OFFBOARD": 6}
PX4_AUTO = {"TAKEOFF": 2, "LOITER": 3, "RTL": 5, "LAND": 6}


class Pilot:
    """What both have in common."""

    modes_to_arm_in: tuple[str, ...] = ()
    """Those that want a position."""
    holds_in = ""
    """The mode that holds a place by itself, sticks centred."""
    flown_in = ""
    """The mode that takes places to go to."""
    forward = CENTRED
    """Sticks that ask for two or three metres a second forward."""

    def __init__(self, ground: Ground, firmware: Simulator) -> None:
        self._ground, self._firmware = ground, firmware
        ground.hold_sticks = self._sticks

    def hold_sticks(self, in_air: bool) -> None:
        """Have a remote control, and hold its sticks so that nothing is asked of the vehicle."""
        self._ground.sticks = lambda: CENTRED if in_air else THROTTLE_LOW

    def set_mode(self, name: str, timeout_s: float = 6.0) -> bool:
        """Whether it took a mode."""
        end_s = time.monotonic() + timeout_s
        while time.monotonic() < end_s:
            self._ask_for_mode(name)
            if self._ground.until(lambda: self._ground.mode == name, 1.5):
                return True
        return False

    def arm(self, timeout_s: float = 6.0) -> bool:
        """Whether it could be armed, with all of its checks on."""
        end_s = time.monotonic() + timeout_s
        while time.monotonic() < end_s:
            self._ground.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0, timeout_s=ACK_S)
            if self._ground.until(lambda: self._ground.armed, 1.5):
                return True
        return False

    def disarm(self) -> bool:
        """Whether the motors are off now, whatever it was doing."""
        self._ground.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0.0, FORCED)
        return self._ground.until(lambda: not self._ground.armed, 3.0)

    def take_off(self, height_m: float, timeout_s: float = 30.0) -> bool:
        """Whether it rose by so much, as it believes."""
        down_m = self._ground.believed_m[2]
        if not self._rise(height_m):
            return False
        wanted_m = down_m - height_m
        self.hold_sticks(in_air=True)
        return self._ground.until(lambda: self._ground.believed_m[2] < wanted_m + 0.3, timeout_s)

    def stream(self, setpoint: Callable[[], tuple[Array, Array, float]] | None) -> None:
        """Have it follow (place, velocity, heading), asked for at 20 Hz; None: no longer."""
        if setpoint is None:
            self._ground.setpoint = None
            return

        def message() -> mavlink.MAVLink_set_position_target_local_ned_message:
            place, velocity, yaw_rad = setpoint()
            mask = PLACE_SPEED_AND_YAW if velocity.any() else PLACE_AND_YAW
            return mavlink.MAVLink_set_position_target_local_ned_message(
                0, 1, 1, mavlink.MAV_FRAME_LOCAL_NED, mask, *place, *velocity, 0, 0, 0, yaw_rad, 0
            )  # fmt: skip

        self._ground.setpoint = message

    def go_to(
        self, place_m: Array, yaw_rad: float, within_m: float = 0.25, timeout_s: float = 30.0
    ) -> bool:
        """Whether it believes to have come there."""
        self.stream(lambda: (place_m, np.zeros(3), yaw_rad))
        return self._ground.until(
            lambda: np.linalg.norm(self._ground.believed_m - place_m) < within_m, timeout_s
        )

    def send_to(self, place_m: Array) -> None:
        """Tell it a place once, from where on the way and the heading are its own."""
        self.stream(None)
        message = mavlink.MAVLink_set_position_target_local_ned_message(
            0, 1, 1, mavlink.MAV_FRAME_LOCAL_NED, PLACE, *place_m, *np.zeros(8)
        )
        for _ in range(SET_TIMES):
            self._ground.send(message)

    def land(self, timeout_s: float = 60.0) -> bool:
        """Whether it landed and disarmed by itself."""
        self.stream(None)
        self.hold_sticks(in_air=False)
        self._begin_landing()
        return self._ground.until(lambda: not self._ground.armed, timeout_s)

    def set_parameters(self, values: Mapping[str, float]) -> None:
        """Set some in the air."""
        for name, value in values.items():
            message = mavlink.MAVLink_param_set_message(
                1, 1, name.encode(), value, mavlink.MAV_PARAM_TYPE_REAL32
            )
            for _ in range(SET_TIMES):
                self._ground.send(message)
                time.sleep(0.1)

    def lose_gps(self) -> None:
        """Have the simulated receiver see nothing any more."""
        raise NotImplementedError

    def _ask_for_mode(self, name: str) -> None:
        raise NotImplementedError

    def _rise(self, height_m: float) -> bool:
        raise NotImplementedError

    def _begin_landing(self) -> None:
        raise NotImplementedError

    def _sticks(self, at: tuple[float, float, float, float]) -> mavlink.MAVLink_message:
        raise NotImplementedError


class CopterPilot(Pilot):
    """ArduCopter."""

    modes_to_arm_in = ("LOITER", "GUIDED")
    holds_in = "LOITER"
    flown_in = "GUIDED"
    forward = 0.0, -0.25, 0.5, 0.0  # of its LOIT_SPEED of 12.5 m/s

    def __init__(self, ground: Ground, firmware: Simulator) -> None:
        super().__init__(ground, firmware)
        names = {number: name for name, number in COPTER_MODES.items()}
        ground.named = lambda mode: names.get(mode, str(mode))

    def lose_gps(self) -> None:
        """See `Pilot`."""
        self.set_parameters({"SIM_GPS1_ENABLE": 0.0})

    def _ask_for_mode(self, name: str) -> None:
        custom = float(mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED)
        number = float(COPTER_MODES[name])
        self._ground.command(mavlink.MAV_CMD_DO_SET_MODE, custom, number, timeout_s=ACK_S)

    def _rise(self, height_m: float) -> bool:
        done = self._ground.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, height_m)
        return done == int(mavlink.MAV_RESULT_ACCEPTED)

    def _begin_landing(self) -> None:
        self.set_mode("LAND")

    def _sticks(self, at: tuple[float, float, float, float]) -> mavlink.MAVLink_message:
        roll, pitch, throttle, yaw = at
        pulses = (1500 + 500 * roll, 1500 + 500 * pitch, 1000 + 1000 * throttle, 1500 + 500 * yaw)
        return mavlink.MAVLink_rc_channels_override_message(
            1, 1, *(round(each) for each in pulses), *[65535] * 4
        )


class Px4Pilot(Pilot):
    """PX4."""

    modes_to_arm_in = ("POSCTL",)
    holds_in = "POSCTL"
    flown_in = "OFFBOARD"
    forward = 0.0, 0.7, 0.5, 0.0  # of an MPC_VEL_MANUAL of 5 m/s, by its curve
    higher = 0.0, 0.0, 0.75, 0.0  # half a metre a second or one

    def __init__(self, ground: Ground, firmware: Simulator) -> None:
        super().__init__(ground, firmware)
        ground.named = self._named

    def hold_sticks(self, in_air: bool) -> None:
        """See `Pilot`; always centred: it takes a stick that moves for a pilot who takes over."""
        self._ground.sticks = lambda: CENTRED

    def go_to(
        self, place_m: Array, yaw_rad: float, within_m: float = 0.25, timeout_s: float = 30.0
    ) -> bool:
        """See `Pilot`."""
        began_s, start = time.monotonic(), self._ground.believed_m
        way = np.asarray(place_m) - start
        lasts_s = float(np.linalg.norm(way)) / PX4_SPEED_M_S

        def setpoint() -> tuple[Array, Array, float]:
            share = min(1.0, (time.monotonic() - began_s) / max(lasts_s, 1e-3))
            return start + share * way, np.zeros(3), yaw_rad

        self.stream(setpoint)
        return self._ground.until(
            lambda: np.linalg.norm(self._ground.believed_m - place_m) < within_m, timeout_s
        )

    def lose_gps(self) -> None:
        """See `Pilot`."""
        assert isinstance(self._firmware, Px4)
        self._firmware.shell("param", "set", "SIM_GPS_USED", "0")

    @staticmethod
    def _named(mode: int) -> str:
        main, sub = mode >> 16 & 255, mode >> 24
        if main == PX4_MAIN["AUTO"]:
            return next((f"AUTO.{k}" for k, v in PX4_AUTO.items() if v == sub), f"AUTO.{sub}")
        return next((k for k, v in PX4_MAIN.items() if v == main), str(main))

    def _ask_for_mode(self, name: str) -> None:
        main, _, sub = name.partition(".")
        custom = float(mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED)
        numbers = float(PX4_MAIN[main]), float(PX4_AUTO.get(sub, 0))
        self._ground.command(mavlink.MAV_CMD_DO_SET_MODE, custom, *numbers, timeout_s=ACK_S)

    def _rise(self, height_m: float) -> bool:
        heard = self._ground.latest.get("GLOBAL_POSITION_INT")
        altitude_m = heard.alt * 1e-3 if heard else self._firmware.home.altitude_m
        nan = math.nan
        done = self._ground.command(
            mavlink.MAV_CMD_NAV_TAKEOFF, nan, 0, 0, nan, nan, nan, altitude_m + height_m
        )
        return done == int(mavlink.MAV_RESULT_ACCEPTED)

    def _begin_landing(self) -> None:
        self._ground.command(mavlink.MAV_CMD_NAV_LAND)

    def _sticks(self, at: tuple[float, float, float, float]) -> mavlink.MAVLink_message:
        roll, pitch, throttle, yaw = (round(1000 * each) for each in at)
        return mavlink.MAVLink_manual_control_message(1, pitch, roll, throttle, yaw, 0)


PILOTS = {"ArduCopter": CopterPilot, "PX4": Px4Pilot}
