"""Parameters of a simulated autopilot, with factory values."""

from __future__ import annotations

import struct

from pymavlink.dialects.v20 import ardupilotmega as mavlink

INT8, INT16 = mavlink.MAV_PARAM_TYPE_INT8, mavlink.MAV_PARAM_TYPE_INT16
INT32, REAL32 = mavlink.MAV_PARAM_TYPE_INT32, mavlink.MAV_PARAM_TYPE_REAL32

ARDUPILOT: dict[str, tuple[float, int]] = {
    "AHRS_EKF_TYPE": (3, INT8), "AHRS_ORIENTATION": (0, INT8), "ARMING_CHECK": (1, INT32),
    "BRD_TYPE": (24, INT8), "COMPASS_ENABLE": (1, INT8), "COMPASS_USE": (1, INT8),
    "COMPASS_USE2": (1, INT8), "COMPASS_USE3": (1, INT8), "EK2_ENABLE": (0, INT8),
    "EK3_ENABLE": (1, INT8), "EK3_GPS_CHECK": (31, INT8), "EK3_IMU_MASK": (3, INT8),
    "EK3_SRC1_POSXY": (3, INT8), "EK3_SRC1_POSZ": (1, INT8), "EK3_SRC1_VELXY": (3, INT8),
    "EK3_SRC1_VELZ": (3, INT8), "EK3_SRC1_YAW": (1, INT8), "EK3_SRC2_POSXY": (0, INT8),
    "EK3_SRC2_POSZ": (1, INT8), "EK3_SRC2_VELXY": (0, INT8), "EK3_SRC2_VELZ": (0, INT8),
    "EK3_SRC2_YAW": (0, INT8), "EK3_SRC_OPTIONS": (1, INT16), "FS_EKF_ACTION": (1, INT8),
    "FS_EKF_THRESH": (0.8, REAL32), "FS_GCS_ENABLE": (0, INT8), "GPS1_TYPE": (1, INT8),
    "LOG_BITMASK": (176126, INT32), "PILOT_SPEED_UP": (250, INT16), "RNGFND1_TYPE": (0, INT8),
    "RTL_ALT": (1500, INT32), "SCHED_LOOP_RATE": (400, INT16), "SERIAL1_BAUD": (57, INT32),
    "SERIAL1_PROTOCOL": (2, INT8), "SERIAL2_BAUD": (921, INT32), "SERIAL2_PROTOCOL": (2, INT8),
    "SR1_EXTRA1": (0, INT16), "SR1_POSITION": (0, INT16), "SYSID_MYGCS": (255, INT16),
    "SYSID_THISMAV": (1, INT16), "VISO_DELAY_MS": (10, INT16), "VISO_ORIENT": (0, INT8),
    "VISO_POS_M_NSE": (0.2, REAL32), "VISO_POS_X": (0, REAL32), "VISO_POS_Y": (0, REAL32),
    "VISO_POS_Z": (0, REAL32), "VISO_QUAL_MIN": (0, INT8), "VISO_SCALE": (1, REAL32),
    "VISO_TYPE": (0, INT8), "VISO_VEL_M_NSE": (0.1, REAL32), "VISO_YAW_M_NSE": (0.2, REAL32),
}  # fmt: skip
PX4: dict[str, tuple[float, int]] = {
    "CAL_ACC0_ID": (1310988, INT32), "COM_ARM_WO_GPS": (1, INT32), "EKF2_BARO_CTRL": (1, INT32),
    "EKF2_EN": (1, INT32), "EKF2_EVA_NOISE": (0.1, REAL32), "EKF2_EVP_GATE": (5, REAL32),
    "EKF2_EVP_NOISE": (0.1, REAL32), "EKF2_EVV_NOISE": (0.1, REAL32), "EKF2_EV_CTRL": (0, INT32),
    "EKF2_EV_DELAY": (0, REAL32), "EKF2_EV_NOISE_MD": (0, INT32), "EKF2_EV_POS_X": (0, REAL32),
    "EKF2_EV_POS_Y": (0, REAL32), "EKF2_EV_POS_Z": (0, REAL32), "EKF2_EV_QMIN": (0, INT32),
    "EKF2_GPS_CTRL": (7, INT32), "EKF2_HGT_REF": (1, INT32), "EKF2_MAG_TYPE": (0, INT32),
    "EKF2_NOAID_TOUT": (5000000, INT32), "MAV_0_CONFIG": (101, INT32), "MAV_0_MODE": (0, INT32),
    "MAV_1_CONFIG": (0, INT32), "MAV_1_MODE": (2, INT32), "MAV_ODOM_LP": (0, INT32),
    "MAV_SYS_ID": (1, INT32), "MIS_TAKEOFF_ALT": (15, REAL32), "SDLOG_PROFILE": (1, INT32),
    "SENS_BOARD_X_OFF": (0.000001, REAL32), "SER_TEL1_BAUD": (57600, INT32),
    "SER_TEL2_BAUD": (921600, INT32), "SYS_AUTOSTART": (10040, INT32), "SYS_HAS_GPS": (1, INT32),
    "SYS_HAS_MAG": (1, INT32), "SYS_MC_EST_GROUP": (2, INT32),
}  # fmt: skip


class Parameters:
    """A table of parameters, and how either firmware puts a value into a message's float.

    ArduPilot casts to float; PX4 puts the bytes of an integer there. ArduPilot lists no parameters
    of what is switched off (VISO_TYPE 0), yet reads and sets them by name.
    """

    def __init__(self, firmware: str) -> None:
        self._bytewise = firmware == "px4"
        self._table = dict(PX4 if self._bytewise else ARDUPILOT)
        self.refused: set[str] = set()
        """Names whose writing is answered with the old value."""
        self.stored: dict[str, float] = {}
        """What is in flash: of PX4 what it was told to store, of ArduPilot all that was set."""

    def __getitem__(self, name: str) -> float:
        return self._table[name][0]

    def __setitem__(self, name: str, value: float) -> None:
        kind = self._table[name][1]
        if kind == REAL32:
            (value,) = struct.unpack("<f", struct.pack("<f", value))
        self._table[name] = (value if kind == REAL32 else int(value), kind)

    def __contains__(self, name: str) -> bool:
        return name in self._table

    def __delitem__(self, name: str) -> None:
        """As on a firmware that has no such parameter."""
        del self._table[name]

    def listed(self) -> list[str]:
        """Names in the order of their indices."""
        off = not self._bytewise and self._table.get("VISO_TYPE", (0, INT8))[0] == 0
        return sorted(
            name
            for name in self._table
            if not (off and name.startswith("VISO_") and name != "VISO_TYPE")
        )

    def value_message(self, name: str) -> object:
        value, kind = self._table[name]
        names = self.listed()
        if self._bytewise and kind == INT32:
            (value,) = struct.unpack("<f", struct.pack("<i", int(value)))
        index = names.index(name) if name in names else 65535
        return mavlink.MAVLink_param_value_message(name.encode(), value, kind, len(names), index)

    def set(self, name: str, value: float, kind: int) -> None:
        """Take a PARAM_SET as the firmware would."""
        if name in self.refused:
            return
        if self._bytewise and self._table[name][1] == INT32:
            if kind != INT32:  # PX4 does not write a value of another type
                return
            (value,) = struct.unpack("<i", struct.pack("<f", value))
        self[name] = value
        if not self._bytewise:
            self.stored[name] = self[name]

    def store(self) -> None:
        """As at MAV_CMD_PREFLIGHT_STORAGE."""
        self.stored = {name: self[name] for name in self._table}
