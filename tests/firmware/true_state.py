"""True state of a simulated vehicle, as its firmware tells it over MAVLink.

    with TrueState(port, origin) as truth:
        state = truth.at(unix_s, wait_s=0.03)

ArduPilot tells it by SIM_STATE, PX4's SIH by HIL_STATE_QUATERNION; both are asked for, until one
comes as often as wanted. Neither bears a time that a camera could use: a state is that of its
arrival, as the kernel stamps it. The place in both is rounded to 1e-7 degrees and to centimetres or
millimetres, the velocity is nearly exact: it is integrated, and led by the place.
"""

from __future__ import annotations

import contextlib
import math
import socket
import struct
import threading
import time
from collections import deque
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.geometry.geodesy import GeoOrigin, ned_from_geodetic
from companion.geometry.transforms import (
    Array,
    Pose,
    interpolate_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
)

RATE_HZ = 200.0
KEPT = 2000
"""States: of ten seconds."""
ARDUPILOT_M = 0.011131884502145034
"""Metres of 1e-7 degrees in ArduPilot, whose Earth is a sphere, as its velocities have it."""
LED_S = 0.7
"""Time constant with which the integrated place follows the told one: with 200 states a second it
averages over a hundred roundings, and forgets what a late arrival has put in."""
GAP_S = 0.2
"""A longer pause is not bridged: neither by integration nor between two states."""
JUMP_M = 0.5
"""The told place is believed at once where the integrated one is off by more: the vehicle was set
elsewhere, as it is by a reboot."""
AHEAD_S = 0.05
"""A state is carried on for as long by its own velocity and rates."""
ASK_EVERY_S = 1.0
SO_TIMESTAMPNS = 35
"""Kernel's stamps of arrival; Python has no name for it. The same number on x86-64 and aarch64."""
OWN_SYSTEM, OWN_COMPONENT, AUTOPILOT = 254, 191, 1


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Vehicle at a time (Unix, seconds), in NED about the origin."""

    t_s: float
    place_m: Array
    velocity_m_s: Array
    quaternion: Array
    """World from body, w x y z."""
    rates_rad_s: Array

    def pose(self) -> Pose:
        """World from body."""
        return Pose(rotation_from_quaternion(self.quaternion), self.place_m)


class TrueState:
    """See above. Without an origin the first place told is it.

    `take` may be called in place of listening, by what has messages already.
    """

    def __init__(self, port: int = 0, origin: GeoOrigin | None = None) -> None:
        self.origin = origin
        self._port = port
        self._states: deque[State] = deque(maxlen=KEPT)
        self._came = threading.Condition()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._listen, name="true state", daemon=True)
        self._asked_s, self._n_since = 0.0, 0

    def __enter__(self) -> TrueState:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self._stop.set()
        self._thread.join()

    @property
    def newest(self) -> State | None:
        """None before the first."""
        with self._came:
            return self._states[-1] if self._states else None

    def since(self, t_s: float) -> list[State]:
        """All states that came after a time, as far as they are kept."""
        with self._came:
            return [state for state in self._states if state.t_s > t_s]

    def at(self, t_s: float, wait_s: float = 0.0) -> Pose | None:
        """World from body at a time; None where it is not known, nor becomes so in `wait_s`."""
        with self._came:
            self._came.wait_for(lambda: self._states and self._states[-1].t_s >= t_s, wait_s)
            after = before = None
            for state in reversed(self._states):
                if state.t_s <= t_s:
                    before = state
                    break
                after = state
        if before is None:
            return None
        if after is None:
            ahead_s = t_s - before.t_s
            return _carried_on(before, ahead_s) if ahead_s <= AHEAD_S else None
        whole_s = after.t_s - before.t_s
        if whole_s > GAP_S:
            return None
        share = (t_s - before.t_s) / whole_s
        a, b = before.pose(), after.pose()
        return Pose(
            interpolate_rotation(a.rotation, b.rotation, share),
            (1 - share) * a.translation + share * b.translation,
        )

    def take(self, message: Any, t_s: float) -> None:
        """Take in a message that came at a time; others than the two are passed over."""
        kind = message.get_type()
        if kind == "SIM_STATE":
            place = self._place_on_sphere(message.lat_int, message.lon_int, float(message.alt))
            velocity = np.array([message.vn, message.ve, message.vd])
            quaternion = np.array([message.q1, message.q2, message.q3, message.q4])
            rates = np.array([message.xgyro, message.ygyro, message.zgyro])
        elif kind == "HIL_STATE_QUATERNION":
            place = self._place_on_ellipsoid(
                message.lat * 1e-7, message.lon * 1e-7, message.alt * 1e-3
            )
            velocity = np.array([message.vx, message.vy, message.vz]) * 0.01
            quaternion = np.array(message.attitude_quaternion, np.float64)
            rates = np.array([message.rollspeed, message.pitchspeed, message.yawspeed])
        else:
            return
        with self._came:
            last = self._states[-1] if self._states else None
            if last is not None and t_s <= last.t_s:
                if last.t_s - t_s < GAP_S:
                    return  # two at once
                self._states.clear()  # the clock was set back
                last = None
            if last is not None:
                place = _led(last, place, velocity, t_s - last.t_s)
            self._states.append(State(t_s, place, velocity, quaternion, rates))
            self._n_since += 1
            self._came.notify_all()

    def _place_on_sphere(self, latitude_e7: int, longitude_e7: int, altitude_m: float) -> Array:
        if self.origin is None:
            self.origin = GeoOrigin(latitude_e7 * 1e-7, longitude_e7 * 1e-7, altitude_m)
        zero = self.origin
        middle_deg = 0.5 * (latitude_e7 * 1e-7 + zero.latitude_deg)
        return np.array([
            (latitude_e7 - zero.latitude_deg * 1e7) * ARDUPILOT_M,
            (longitude_e7 - zero.longitude_deg * 1e7)
            * ARDUPILOT_M * math.cos(math.radians(middle_deg)),
            zero.altitude_m - altitude_m,
        ])  # fmt: skip

    def _place_on_ellipsoid(
        self, latitude_deg: float, longitude_deg: float, altitude_m: float
    ) -> Array:
        if self.origin is None:
            self.origin = GeoOrigin(latitude_deg, longitude_deg, altitude_m)
        return ned_from_geodetic(latitude_deg, longitude_deg, altitude_m, self.origin)

    def _listen(self) -> None:
        parser = mavlink.MAVLink(None)
        parser.robust_parsing = True
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
            wire.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
            wire.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
            wire.bind(("127.0.0.1", self._port))
            wire.settimeout(0.2)
            peer: Any = None
            while not self._stop.is_set():
                with contextlib.suppress(TimeoutError):
                    data, stamps, _, peer = wire.recvmsg(1 << 16, socket.CMSG_SPACE(16))
                    seconds, nanoseconds = struct.unpack("qq", stamps[0][2])
                    for message in parser.parse_buffer(data) or []:
                        self.take(message, seconds + nanoseconds * 1e-9)
                if peer is not None:
                    self._ask(wire, peer)

    def _ask(self, wire: socket.socket, peer: Any) -> None:
        """Ask for states, unless they come half as often as wanted: a reboot has forgotten it."""
        passed_s = time.monotonic() - self._asked_s
        if passed_s < ASK_EVERY_S:
            return
        enough = self._n_since >= 0.5 * RATE_HZ * passed_s
        self._asked_s, self._n_since = time.monotonic(), 0
        if enough:
            return
        pack = mavlink.MAVLink(None, srcSystem=OWN_SYSTEM, srcComponent=OWN_COMPONENT)
        for number in (
            mavlink.MAVLINK_MSG_ID_SIM_STATE, mavlink.MAVLINK_MSG_ID_HIL_STATE_QUATERNION,
        ):  # fmt: skip
            command = mavlink.MAVLink_command_long_message(
                AUTOPILOT, AUTOPILOT, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 0,
                number, 1e6 / RATE_HZ, 0, 0, 0, 0, 0,
            )  # fmt: skip
            with contextlib.suppress(OSError):  # it may be gone just now
                wire.sendto(command.pack(pack), peer)


def _led(last: State, told: Array, velocity: Array, passed_s: float) -> Array:
    """The place integrated from the last state, led by the told one."""
    if passed_s > GAP_S:
        return told
    integrated = last.place_m + 0.5 * passed_s * (last.velocity_m_s + velocity)
    off = told - integrated
    if np.abs(off).max() > JUMP_M:
        return told
    led: Array = integrated + passed_s / LED_S * off
    return led


def _carried_on(state: State, ahead_s: float) -> Pose:
    pose = state.pose()
    return Pose(
        pose.rotation @ rotation_from_vector(ahead_s * state.rates_rad_s),
        pose.translation + ahead_s * state.velocity_m_s,
    )
