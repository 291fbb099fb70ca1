"""Measurements of a simulated autopilot: a synthetic trajectory, or a recorded flight."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.geometry.geodesy import GeoOrigin, origin_of
from companion.geometry.transforms import (
    Array,
    Pose,
    quaternion_from_rotation,
    vector_from_rotation,
)
from companion.timing.log_clock import BootSegments
from drivers.telemetry.mavlink_samples import boot_ns
from drivers.telemetry.telemetry_tlog import read_tlog
from drivers.telemetry.tlog_records import TlogRecords

HERE = GeoOrigin(47.397742, 8.545594, 489.0)
GRAVITY_M_S2 = 9.80665
STEP_S, IMU_STEP_S = 0.01, 0.02
SEA_LEVEL_HPA, SCALE_M, EXPONENT = 1013.25, 44330.77, 0.1902632

MEASURED = (
    "ATTITUDE", "ATTITUDE_QUATERNION", "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT", "GPS_RAW_INT",
    "SCALED_PRESSURE", "HIGHRES_IMU", "RAW_IMU", "SCALED_IMU", "DISTANCE_SENSOR", "VFR_HUD",
)  # fmt: skip


class Flight(Protocol):
    """Messages over the time of the flight, in seconds from its beginning."""

    kinds: frozenset[str]
    duration_s: float
    origin: GeoOrigin
    begin_unix_ns: int
    """Time of its beginning by the clock that also stamped its pictures; 0 where it has none."""

    def message(self, kind: str, flight_s: float) -> tuple[Any, float] | None:
        """The newest of a kind at a time, and the time at which it was measured.

        Its own stamps mean nothing. None where there is none yet.
        """


class MadeUpFlight:
    """Perfect sensors along a trajectory: `world_from_body(seconds)` in local NED."""

    def __init__(
        self,
        world_from_body: Callable[[float], Pose],
        duration_s: float = math.inf,
        origin: GeoOrigin = HERE,
        ground_ned_m: float = 0.0,
    ) -> None:
        self._pose = world_from_body
        self._ground_m = ground_ned_m
        self.duration_s, self.origin, self.begin_unix_ns = duration_s, origin, 0
        self.kinds = frozenset(MEASURED)
        self._make: dict[str, Callable[[float], Any]] = {
            kind: getattr(self, f"_{kind.lower()}") for kind in MEASURED
        }

    def message(self, kind: str, flight_s: float) -> tuple[Any, float] | None:
        if kind not in self._make:
            return None
        return self._make[kind](flight_s), flight_s

    def _velocity(self, t_s: float) -> Array:
        ahead, behind = self._pose(t_s + STEP_S), self._pose(t_s - STEP_S)
        out: Array = (ahead.translation - behind.translation) / (2 * STEP_S)
        return out

    def _rates(self, t_s: float) -> Array:
        ahead, behind = self._pose(t_s + STEP_S), self._pose(t_s - STEP_S)
        return vector_from_rotation(behind.rotation.T @ ahead.rotation) / (2 * STEP_S)

    def _inertial(self, t_s: float) -> tuple[Array, Array]:
        """Specific force and rates of turn, by three poses: it is called 100 times a second."""
        behind, here, ahead = (self._pose(t_s + n * IMU_STEP_S) for n in (-1, 0, 1))
        accel = ahead.translation - 2 * here.translation + behind.translation
        force: Array = here.rotation.T @ (accel / IMU_STEP_S**2 - [0, 0, GRAVITY_M_S2])
        turned = vector_from_rotation(behind.rotation.T @ ahead.rotation)
        return force, turned / (2 * IMU_STEP_S)

    def _attitude(self, t_s: float) -> Any:
        r = self._pose(t_s).rotation
        roll, yaw = math.atan2(r[2, 1], r[2, 2]), math.atan2(r[1, 0], r[0, 0])
        pitch = -math.asin(max(-1.0, min(1.0, r[2, 0])))
        return mavlink.MAVLink_attitude_message(0, roll, pitch, yaw, *self._rates(t_s))

    def _attitude_quaternion(self, t_s: float) -> Any:
        q = quaternion_from_rotation(self._pose(t_s).rotation)
        return mavlink.MAVLink_attitude_quaternion_message(0, *q, *self._rates(t_s), [0.0] * 4)

    def _local_position_ned(self, t_s: float) -> Any:
        place = self._pose(t_s).translation
        return mavlink.MAVLink_local_position_ned_message(0, *place, *self._velocity(t_s))

    def _place(self, t_s: float) -> tuple[int, int, int]:
        """Degrees * 1e7, degrees * 1e7, millimetres."""
        here = self._pose(t_s).translation
        # the place is the origin of a frame in which the true origin has the opposite position
        o = self.origin
        there = origin_of(o.latitude_deg, o.longitude_deg, o.altitude_m, -here)
        return (
            round(there.latitude_deg * 1e7),
            round(there.longitude_deg * 1e7),
            round(there.altitude_m * 1e3),
        )

    def _global_position_int(self, t_s: float) -> Any:
        lat, lon, alt = self._place(t_s)
        up_mm = round(-1e3 * self._pose(t_s).translation[2])
        v = np.rint(100 * self._velocity(t_s)).astype(int).tolist()
        return mavlink.MAVLink_global_position_int_message(0, lat, lon, alt, up_mm, *v, 65535)

    def _gps_raw_int(self, t_s: float) -> Any:
        lat, lon, alt = self._place(t_s)
        north, east, _ = self._velocity(t_s)
        speed = round(100 * math.hypot(north, east))
        course = round(math.degrees(math.atan2(east, north)) % 360 * 100) % 36000
        return mavlink.MAVLink_gps_raw_int_message(
            0, 3, lat, lon, alt, 80, 120, speed, course, 12, alt, 900, 1500, 300, 0, 0
        )

    def _scaled_pressure(self, t_s: float) -> Any:
        height_m = self.origin.altitude_m - self._pose(t_s).translation[2]
        hpa = SEA_LEVEL_HPA * (1 - height_m / SCALE_M) ** (1 / EXPONENT)
        return mavlink.MAVLink_scaled_pressure_message(0, hpa, 0.0, 2000, 0)

    def _highres_imu(self, t_s: float) -> Any:
        force, rates = self._inertial(t_s)
        return mavlink.MAVLink_highres_imu_message(
            0, *force, *rates, 0.2, 0.0, 0.4, 950.0, 0.0, 500.0, 20.0, 63, 0
        )

    def _milli(self, t_s: float) -> list[int]:
        force, rates = self._inertial(t_s)
        accel = np.rint(1000 / GRAVITY_M_S2 * force).astype(int).tolist()
        return [*accel, *np.rint(1000 * rates).astype(int).tolist(), 0, 0, 0]

    def _raw_imu(self, t_s: float) -> Any:
        return mavlink.MAVLink_raw_imu_message(0, *self._milli(t_s), 0, 2000)

    def _scaled_imu(self, t_s: float) -> Any:
        return mavlink.MAVLink_scaled_imu_message(0, *self._milli(t_s), 2000)

    def _distance_sensor(self, t_s: float) -> Any:
        pose = self._pose(t_s)
        down = max(0.2, float(pose.rotation[2, 2]))
        range_cm = max(0, round(100 * (self._ground_m - pose.translation[2]) / down))
        range_cm = min(range_cm, 65535)
        return mavlink.MAVLink_distance_sensor_message(0, 10, 4000, range_cm, 0, 0, 25, 0)

    def _vfr_hud(self, t_s: float) -> Any:
        v, down = self._velocity(t_s), self._pose(t_s).translation[2]
        speed = float(np.linalg.norm(v[:2]))
        return mavlink.MAVLink_vfr_hud_message(
            speed, speed, 0, 50, self.origin.altitude_m - down, -v[2]
        )


class RecordedFlight:
    """The autopilot's own messages out of a .tlog, or of the one in a flight folder."""

    def __init__(self, path: Path) -> None:
        if path.is_dir():
            path = next(iter(sorted(path.glob("*.tlog"))))
        content = read_tlog(path)
        if content.host_ns is None:
            raise ValueError(f"{path}: no telemetry of an autopilot")
        self.origin = content.collected.finish(content.host_ns, content.clock).origin or HERE
        log = TlogRecords(path.read_bytes())
        found: list[tuple[int, int, Any]] = []
        segments, unix_minus_boot_ns = BootSegments(), None
        for record in log:
            if record.component != mavlink.MAV_COMP_ID_AUTOPILOT1:
                continue
            message = log.decode(record)
            if message is None:
                continue
            if message.get_type() == "SYSTEM_TIME" and message.time_unix_usec:
                unix_minus_boot_ns = message.time_unix_usec * 1000 - message.time_boot_ms * 10**6
            remote_ns = boot_ns(message, unix_minus_boot_ns)
            if message.get_type() in MEASURED and remote_ns is not None:
                found.append((remote_ns, segments.segment_of(remote_ns), message))
        hosts = content.host_ns(
            np.array([each[0] for each in found]), np.array([each[1] for each in found])
        )
        self.begin_unix_ns = int(hosts.min())
        self.duration_s = float(hosts.max() - hosts.min()) * 1e-9
        self._times: dict[str, list[float]] = {}
        self._messages: dict[str, list[Any]] = {}
        for host_ns, (_, _, message) in sorted(
            zip(hosts.tolist(), found, strict=True), key=lambda each: each[0]
        ):
            kind = message.get_type()
            self._times.setdefault(kind, []).append((host_ns - self.begin_unix_ns) * 1e-9)
            self._messages.setdefault(kind, []).append(message)
        self.kinds = frozenset(self._messages)

    def message(self, kind: str, flight_s: float) -> tuple[Any, float] | None:
        times = self._times.get(kind)
        if not times:
            return None
        place = max(0, bisect_right(times, flight_s) - 1)
        return self._messages[kind][place], times[place]


def hover(height_m: float = 10.0) -> MadeUpFlight:
    """Standing still in the air."""
    pose = Pose(np.eye(3), np.array([0.0, 0.0, -height_m]))
    return MadeUpFlight(lambda _t_s: pose)


def circle(radius_m: float = 10.0, height_m: float = 10.0, period_s: float = 20.0) -> MadeUpFlight:
    """Round and round, nose ahead."""

    def pose(t_s: float) -> Pose:
        angle = 2 * math.pi * t_s / period_s
        c, s = math.cos(angle), math.sin(angle)
        rotation = np.array([[-s, -c, 0], [c, -s, 0], [0, 0, 1.0]])
        return Pose(rotation, np.array([radius_m * c, radius_m * s, -height_m]))

    return MadeUpFlight(pose)
