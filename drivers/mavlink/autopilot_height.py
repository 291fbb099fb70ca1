"""The autopilot's position along the down axis of its local frame.

ArduPilot's EKF3 takes the height of the first external pose for its own, so poses begin at the
height that it already has. LOCAL_POSITION_NED has that. ArduCopter withholds this message until it
has a horizontal position, which without satellites comes from our pose: there the height above home
of GLOBAL_POSITION_INT is continued from its value on the ground, or from when both were last
received. (GLOBAL_POSITION_INT's altitude above sea level then stands still: seen with ArduCopter
4.7-dev.)
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.telemetry.mavlink_samples import landed

MAX_AGE_NS = 500_000_000
"""Longest extrapolation of a height by its rate of change: both messages come at 10 Hz, and a
multicopter that accelerates by 2 m/s2 is 0.25 m elsewhere after this."""
STILL_M_S = 0.1
"""Vertical rate on the ground: a landed state is told once a second only, and a vehicle that lifts
off has climbed by a metre until the next."""
LANDED_AGE_NS = 2_000_000_000
"""Validity of EXTENDED_SYS_STATE; autopilots that send it do so each second."""
MOST_AWAY_M = 1e5


class _Height(NamedTuple):
    """Down (m) at a time, and its rate of change (m/s)."""

    t_ns: int
    down_m: float
    rate_m_s: float


class AutopilotHeight:
    """Height of the vehicle in its local frame, from messages of a link, in the event loop."""

    def __init__(self, link: AutopilotLink) -> None:
        self._link = link
        self._local: _Height | None = None
        self._below_home: _Height | None = None
        self.home_down_m: float | None = None
        """Position of home on the local frame's down axis; None while unknown."""
        self._landed_ns: int | None = None
        """Time of the last report that it is on the ground."""
        link.listen(mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, self._take_local)
        link.listen(mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, self._take_global)
        link.listen(mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE, self._take_state)

    def forget(self) -> None:
        """Another boot of the autopilot: its frame is another."""
        self._local = self._below_home = self.home_down_m = self._landed_ns = None

    def resume(self, home_down_m: float | None) -> None:
        """Continue with the state of a process before this one in the same boot."""
        if self.home_down_m is None:
            self.home_down_m = home_down_m

    def down_m(self, t_ns: int) -> float | None:
        """Position at a time of the flight's clock; 0 on the ground, None in the air if unknown."""
        local = _at(self._local, t_ns)
        if local is not None:
            return local
        if self._on_ground(t_ns):
            return 0.0
        below_home = _at(self._below_home, t_ns)
        if below_home is None or self.home_down_m is None:
            return None
        return self.home_down_m + below_home

    def _on_ground(self, t_ns: int) -> bool:
        vehicle = self._link.vehicle
        if vehicle is None:
            return False
        if not vehicle.armed:
            return True
        climbs = any(
            height is not None and abs(height.rate_m_s) > STILL_M_S
            for height in (self._local, self._below_home)
        )
        landed = self._landed_ns is not None and t_ns - self._landed_ns < LANDED_AGE_NS
        return landed and not climbs

    def _take_local(self, message: Any, _receive_ns: int) -> None:
        taken = self._height(message.time_boot_ms, message.z, message.vz)
        if taken is not None:
            self._local = taken

    def _take_global(self, message: Any, _receive_ns: int) -> None:
        taken = self._height(message.time_boot_ms, -1e-3 * message.relative_alt, 1e-2 * message.vz)
        if taken is None:
            return
        self._below_home = taken
        local = _at(self._local, taken.t_ns)
        if local is not None:
            self.home_down_m = local - taken.down_m
        elif self._on_ground(taken.t_ns):
            self.home_down_m = -taken.down_m

    def _take_state(self, message: Any, receive_ns: int) -> None:
        self._landed_ns = receive_ns if landed(message) else None

    def _height(self, boot_ms: int, down_m: float, rate_m_s: float) -> _Height | None:
        t_ns = self._link.clock_filter.host_ns(boot_ms * 1_000_000)
        if t_ns is None or not abs(down_m) < MOST_AWAY_M:  # nan neither
            return None
        return _Height(t_ns, down_m, rate_m_s if math.isfinite(rate_m_s) else 0.0)


def _at(height: _Height | None, t_ns: int) -> float | None:
    if height is None or abs(t_ns - height.t_ns) > MAX_AGE_NS:
        return None
    return height.down_m + height.rate_m_s * (t_ns - height.t_ns) * 1e-9
