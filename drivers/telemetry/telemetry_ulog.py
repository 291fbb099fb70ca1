"""Telemetry of a PX4 log: .ulg, read by pyulog."""

from __future__ import annotations

import contextlib
import io
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyulog import ULog
from pyulog.exceptions import ULogException

from companion.geometry.geodesy import GeoOrigin
from companion.geometry.transforms import Array
from companion.messages import Warned
from companion.telemetry import (
    ArmedSample,
    AttitudeSample,
    HeightSample,
    ImuSample,
    PositionSample,
    PositionSource,
    RangeSample,
    Telemetry,
)
from companion.timing.log_clock import clock_from_utc
from companion.timing.stamp_filter import valid_stamps
from drivers.telemetry.gimbal_messages import device_sample
from drivers.telemetry.mavlink_samples import FIX_3D, UNIX_SINCE_NS
from drivers.telemetry.telemetry_log import GeodeticFix, HostTimes, LogContent, TelemetryCollector

TOPICS = [
    "vehicle_attitude", "vehicle_local_position", "vehicle_global_position",
    "vehicle_gps_position", "sensor_gps", "distance_sensor", "vehicle_air_data", "sensor_combined",
    "vehicle_status", "actuator_armed", "gimbal_device_attitude_status",
]  # fmt: skip
ARMING_STATE_ARMED = 2
DOWN = 25
LATEST_NS = 4_102_444_800 * 10**9  # the year 2100
MAX_SHORT_READS = 100
MAX_LATENCY_US = 1_000_000
DAMAGE = (ULogException, ValueError, KeyError, IndexError, TypeError, AttributeError, struct.error)
"""Exceptions of pyulog for invalid files or damaged definitions."""

Columns = Mapping[str, NDArray[Any]]


def read_ulog(path: Path) -> LogContent:
    """All readable data; without absolute time where there is no UTC by GPS."""
    collected = TelemetryCollector(path.name)
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed):  # pyulog prints what it thinks of the file
            log = ULog(_Bytes(path.read_bytes()), TOPICS, True)
    except DAMAGE as error:
        warned = Warned(0, "damaged telemetry", f"{path.name} cannot be read: {error}")
        return LogContent(collected, warnings=(warned,))
    warnings = []
    if log.file_corruption:
        warnings.append(Warned(0, "damaged telemetry", f"parts of {path.name} passed over"))
    if log.dropouts:
        lost_ms = sum(dropout.duration for dropout in log.dropouts)
        detail = f"{len(log.dropouts)} gaps, {lost_ms} ms in all"
        warnings.append(Warned(0, "telemetry that was not logged", detail))
    topics: dict[str, Columns] = {}
    for data in log.data_list:
        if len(data.data.get("timestamp", ())):
            topics.setdefault(data.name, data.data)  # the first instance of each
    if "baro_alt_meter" in topics.get("sensor_combined", {}):  # firmware before 1.8
        topics.setdefault("vehicle_air_data", topics["sensor_combined"])
    gps = topics.get("vehicle_gps_position", topics.get("sensor_gps"))
    for name, take in _TAKERS.items():
        if name in topics:
            _take_whole(take, collected, topics[name])
    if gps is not None:
        _take_whole(_take_gps, collected, gps)
    host_ns, clock = _host_times(collected, gps)
    return LogContent(collected, host_ns, clock.report if clock else None, tuple(warnings))


class _Bytes(io.BytesIO):
    """File that limits reads at its end: on damaged definitions pyulog can seek without end."""

    _n_short = 0

    def read(self, size: int | None = -1, /) -> bytes:
        """Read; ULogException where the end has been met too often."""
        found = super().read(size)
        self._n_short += size is not None and len(found) < size
        if self._n_short > MAX_SHORT_READS:
            raise ULogException("its definitions are damaged")
        return found


def _take_whole(take: Any, collected: TelemetryCollector, columns: Columns) -> None:
    try:
        take(collected, columns)
    except KeyError as error:  # the format of a topic changes between versions of the firmware
        collected.count(f"a topic of unknown form (no field {error}) left out")


def _host_times(collected: TelemetryCollector, gps: Columns | None) -> tuple[HostTimes | None, Any]:
    stamps, _ = collected.stamps()
    if len(stamps) and stamps.min() > UNIX_SINCE_NS:  # simulators may run on Unix time
        return (lambda remote_ns, segment: remote_ns), None
    if gps is None or "time_utc_usec" not in gps:
        return None, None
    pairs = [
        (boot_ns, int(utc_us) * 1000)
        for boot_ns, utc_us in zip(_stamps_ns(gps), gps["time_utc_usec"].tolist(), strict=True)
        if boot_ns >= 0 and UNIX_SINCE_NS < int(utc_us) * 1000 < LATEST_NS
    ]
    clock = clock_from_utc(pairs)
    if clock is None:
        return None, None
    # segments are origins of local position here, not reboots
    return (lambda remote_ns, segment: clock.host_ns(remote_ns, 0)), clock


def _stamps_ns(columns: Columns) -> list[int]:
    """Times of measurement, where distinct from those of publication.

    A stamp that damage made wild is -1, which `_add` leaves out.
    """
    published = columns["timestamp"].tolist()
    sampled = columns["timestamp_sample"].tolist() if "timestamp_sample" in columns else published
    good = valid_stamps([us * 1000 for us in published], 0, LATEST_NS)
    out = []
    for us, sampled_us, believed in zip(published, sampled, good, strict=True):
        near = 0 <= us - sampled_us <= MAX_LATENCY_US
        out.append((sampled_us if near else us) * 1000 if believed else -1)
    return out


def _add(
    collected: TelemetryCollector, t_ns: int, segment: int, content: Telemetry | GeodeticFix
) -> None:
    if t_ns < 0:
        collected.count("records with an impossible time left out")
    else:
        collected.add(t_ns, segment, content)


def _stacked(columns: Columns, *keys: str) -> Array:
    with np.errstate(invalid="ignore"):  # damage makes numbers that are none; they are left out
        return np.stack([columns[key].astype(np.float64) for key in keys], 1)


def _take_attitude(collected: TelemetryCollector, columns: Columns) -> None:
    q = _stacked(columns, "q[0]", "q[1]", "q[2]", "q[3]")
    norm = np.linalg.norm(q, axis=1)
    for t_ns, each, length in zip(_stamps_ns(columns), q, norm, strict=True):
        if not 0.5 < length < 2:
            collected.count("telemetry with values that are no numbers left out")
            continue
        _add(collected, t_ns, 0, AttitudeSample(0, (each if each[0] >= 0 else -each) / length))


def _take_imu(collected: TelemetryCollector, columns: Columns) -> None:
    gyro = _stacked(columns, *(f"gyro_rad[{k}]" for k in range(3)))
    accel = _stacked(columns, *(f"accelerometer_m_s2[{k}]" for k in range(3)))
    for t_ns, turn, force in zip(_stamps_ns(columns), gyro, accel, strict=True):
        _add(collected, t_ns, 0, ImuSample(0, turn, force))


def _take_local_position(collected: TelemetryCollector, columns: Columns) -> None:
    position = _stacked(columns, "x", "y", "z")
    velocity = _stacked(columns, "vx", "vy", "vz")
    valid = (columns["xy_valid"] > 0) & (columns["z_valid"] > 0)
    moving = (columns["v_xy_valid"] > 0) & (columns["v_z_valid"] > 0)
    sigma = (
        _stacked(columns, "eph", "epv") if "eph" in columns else np.full((len(valid), 2), np.nan)
    )
    segment = _origins(collected, columns)
    for k, t_ns in enumerate(_stamps_ns(columns)):
        if valid[k]:
            sample = PositionSample(
                0, PositionSource.LOCAL, position[k], velocity[k] if moving[k] else None,
                _sigma(sigma[k, 0]), _sigma(sigma[k, 1]),
            )  # fmt: skip
            _add(collected, t_ns, int(segment[k]), sample)


def _origins(collected: TelemetryCollector, columns: Columns) -> NDArray[np.int64]:
    """Number of the estimator's origin for each sample; geodetic origins are stored."""
    known = (columns["xy_global"] > 0) & (columns["z_global"] > 0)
    where = _stacked(columns, "ref_lat", "ref_lon", "ref_alt")
    if np.abs(where[known]).max(initial=0.0) > 1e6:  # 1e-7 degrees and millimetres
        where = where * [1e-7, 1e-7, 1e-3]
    where[~known] = np.nan
    changed = np.any(where[1:] != where[:-1], axis=1) & known[1:]
    # what was before the first known origin has that one, as far as can be told
    first = int(np.argmax(known)) if known.any() else len(known)
    number = np.concatenate([[0], np.cumsum(changed & (np.arange(1, len(known)) > first))])
    for each in range(int(number[-1]) + 1):
        rows = known & (number == each)
        if rows.any():
            collected.origin[each] = GeoOrigin(*map(float, where[rows][0]))
    return number.astype(np.int64)


def _take_global_position(collected: TelemetryCollector, columns: Columns) -> None:
    place = _stacked(columns, "lat", "lon", "alt")
    for t_ns, (lat, lon, alt) in zip(_stamps_ns(columns), place.tolist(), strict=True):
        _add(collected, t_ns, 0, GeodeticFix(PositionSource.GLOBAL, lat, lon, alt))


def _take_gps(collected: TelemetryCollector, columns: Columns) -> None:
    if "latitude_deg" in columns:
        place = _stacked(columns, "latitude_deg", "longitude_deg", "altitude_msl_m")
    else:
        place = _stacked(columns, "lat", "lon", "alt") * [1e-7, 1e-7, 1e-3]
    velocity = _stacked(columns, "vel_n_m_s", "vel_e_m_s", "vel_d_m_s")
    sigma = _stacked(columns, "eph", "epv")
    for k, t_ns in enumerate(_stamps_ns(columns)):
        if columns["fix_type"][k] >= FIX_3D:
            moving = velocity[k] if columns["vel_ned_valid"][k] else None
            lat, lon, alt = map(float, place[k])
            accuracy = _sigma(sigma[k, 0]), _sigma(sigma[k, 1])
            fix = GeodeticFix(PositionSource.GPS, lat, lon, alt, moving, *accuracy)
            _add(collected, t_ns, 0, fix)


def _sigma(value: float) -> float | None:
    return float(value) if 0 < value < 1e4 else None


def _take_gimbal(collected: TelemetryCollector, columns: Columns) -> None:
    q = _stacked(columns, "q[0]", "q[1]", "q[2]", "q[3]")
    failures = columns["failure_flags"].tolist()
    rows = zip(_stamps_ns(columns), q, columns["device_flags"].tolist(), failures, strict=True)
    for t_ns, each, flags, failed in rows:
        sample = device_sample(each, int(flags), int(failed))
        if sample is not None and t_ns >= 0:
            collected.add(t_ns, 0, sample)
        else:
            collected.count("gimbal messages without an attitude left out")


def _take_range(collected: TelemetryCollector, columns: Columns) -> None:
    distance = columns["current_distance"].astype(np.float64)
    within = (distance > np.maximum(columns["min_distance"], 1e-3)) & (
        distance < columns["max_distance"]
    )
    if "orientation" in columns:
        within &= columns["orientation"] == DOWN
    for t_ns, each, good in zip(_stamps_ns(columns), distance, within, strict=True):
        if good:
            _add(collected, t_ns, 0, RangeSample(0, float(each)))


def _take_height(collected: TelemetryCollector, columns: Columns) -> None:
    for t_ns, height in zip(_stamps_ns(columns), columns["baro_alt_meter"], strict=True):
        _add(collected, t_ns, 0, HeightSample(0, float(height)))


def _take_armed(collected: TelemetryCollector, columns: Columns) -> None:
    armed = columns["arming_state"] == ARMING_STATE_ARMED
    changes = np.flatnonzero(np.diff(armed, prepend=~armed[:1]))
    stamps = _stamps_ns(columns)
    for k in changes:
        _add(collected, stamps[k], 0, ArmedSample(0, bool(armed[k])))


_TAKERS = {
    "vehicle_attitude": _take_attitude,
    "sensor_combined": _take_imu,
    "vehicle_local_position": _take_local_position,
    "vehicle_global_position": _take_global_position,
    "distance_sensor": _take_range,
    "gimbal_device_attitude_status": _take_gimbal,
    "vehicle_air_data": _take_height,
    "vehicle_status": _take_armed,
}
