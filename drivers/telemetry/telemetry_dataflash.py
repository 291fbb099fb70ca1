"""Telemetry of an ArduPilot DataFlash log .BIN, version 3.2 and later.

The simulator's truth in simulated logs (SIM, SIM2) is not read.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from companion.geometry.geodesy import GeoOrigin
from companion.geometry.transforms import Array, quaternion_from_euler
from companion.messages import Warned
from companion.telemetry import (
    ArmedSample,
    AttitudeSample,
    GimbalSample,
    HeightSample,
    ImuSample,
    PositionSample,
    PositionSource,
    RangeSample,
    Telemetry,
)
from companion.timing.log_clock import clock_from_utc
from companion.timing.stamp_filter import MAX_BOOT_NS, valid_stamps
from drivers.telemetry.dataflash_records import DataflashRecords
from drivers.telemetry.mavlink_samples import FIX_3D, GPS_RANGE_ERROR_M
from drivers.telemetry.telemetry_log import GeodeticFix, LogContent, TelemetryCollector

KINDS = frozenset({
    "ATT", "IMU", "XKF1", "NKF1", "EKF1", "POS", "GPS", "RFND", "BARO", "ARM", "EV", "ORGN",
    "MNT",
})  # fmt: skip
FILTERS = ("XKF1", "NKF1", "EKF1")
GPS_EPOCH_S = 315_964_800
LEAP_SECONDS = 18
"""UTC is behind GPS time by this since 2017."""
FIRST_WEEK, LAST_WEEK = 1000, 6000
EV_ARMED, EV_DISARMED = 10, 11
EKF_ORIGIN = 0
DOWN = 25
RANGE_GOOD = 4

Values = Mapping[str, Any]


def read_dataflash(path: Path) -> LogContent:
    """All readable records; without absolute time where there is no GPS fix."""
    log = path.read_bytes()
    records = DataflashRecords(log, KINDS)
    rows = list(records)
    warnings = []
    if records.n_damaged:
        detail = f"{records.n_damaged} of {len(log)} bytes of {path.name} passed over"
        warnings.append(Warned(0, "damaged telemetry", detail))
    collected = TelemetryCollector(path.name)
    counts = Counter(name for name, values in rows if values.get("C", 0) == 0)
    chosen = _chosen(counts)
    has_arm = counts["ARM"] > 0
    stamps_ns = _boot_times_ns(rows)
    utc: list[tuple[int, int]] = []
    good = valid_stamps(stamps_ns, 0, MAX_BOOT_NS)
    for (name, values), boot_ns, believed in zip(rows, stamps_ns, good, strict=True):
        if not believed:
            collected.count("records with an impossible time left out")
            continue
        try:
            if name == "ORGN" and values.get("Type") == EKF_ORIGIN:
                origin = GeoOrigin(values["Lat"], values["Lng"], values["Alt"])
                collected.origin.setdefault(0, origin)
            if name == "GPS" and (fix_ns := _utc_ns(values)) is not None:
                utc.append((boot_ns, fix_ns))
            for sample in _samples(name, values, chosen) if name != "EV" or not has_arm else ():
                collected.add(boot_ns, 0, sample)
        except (KeyError, TypeError, ValueError):
            # another version's fields, or a damaged description
            collected.count("records of unknown form left out")
    found = clock_from_utc(utc)
    return LogContent(
        collected,
        found.host_ns if found else None,
        found.report if found else None,
        tuple(warnings),
    )


def _boot_times_ns(rows: Sequence[tuple[str, Values]]) -> list[int]:
    out: list[int] = []
    for name, values in rows:
        stamp_us = values.get("TimeUS")
        stamp_ms = values.get("T") if name == "GPS" else values.get("TimeMS")
        if isinstance(stamp_us, int):
            out.append(stamp_us * 1000)
        elif isinstance(stamp_ms, int):
            out.append(stamp_ms * 1_000_000)
        else:  # events of old firmware: the time is that of the record before
            out.append(out[-1] if out else -1)
    return out


def _utc_ns(values: Values) -> int | None:
    week = values.get("GWk", values.get("Week", 0))
    in_week_ms = values.get("GMS", values.get("TimeMS", 0))
    good = FIRST_WEEK <= week <= LAST_WEEK and in_week_ms < 7 * 86_400_000
    if values["Status"] < FIX_3D or not good:
        return None
    seconds = GPS_EPOCH_S - LEAP_SECONDS + int(week) * 7 * 86400
    return seconds * 10**9 + int(in_week_ms) * 10**6


def _chosen(counts: Counter[str]) -> frozenset[str]:
    """Records to use for attitude and local position, of those that several carry."""
    filtered = next((name for name in FILTERS if counts[name]), None)
    attitude = "ATT" if filtered is None or counts["ATT"] >= counts[filtered] else filtered
    return frozenset({f"{attitude} attitude", f"{filtered} position"})


def _samples(name: str, values: Values, chosen: frozenset[str]) -> list[Telemetry | GeodeticFix]:
    # several of a kind are told apart by an instance or, for filters, a core: the first is taken
    if values.get("I", 0) != 0 or values.get("C", 0) != 0 or values.get("Instance", 0) != 0:
        return []
    out: list[Telemetry | GeodeticFix | None] = []
    if f"{name} attitude" in chosen:
        out.append(_attitude(values))
    if f"{name} position" in chosen:
        out.append(_local_position(values))
    elif name in _SAMPLE_OF:
        out.append(_SAMPLE_OF[name](values))
    return [sample for sample in out if sample is not None]


def _attitude(values: Values) -> Telemetry | None:
    angles = [math.radians(values[key]) for key in ("Roll", "Pitch", "Yaw")]
    if not any(angles):  # before the filter runs
        return None
    return AttitudeSample(0, quaternion_from_euler(*angles))


def _local_position(values: Values) -> Telemetry | None:
    position = _vector(values, "PN", "PE", "PD")
    return PositionSample(0, PositionSource.LOCAL, position, _vector(values, "VN", "VE", "VD"))


def _global_position(values: Values) -> GeodeticFix | None:
    if values["Lat"] == 0 and values["Lng"] == 0:
        return None
    return GeodeticFix(PositionSource.GLOBAL, values["Lat"], values["Lng"], float(values["Alt"]))


def _gps(values: Values) -> GeodeticFix | None:
    if values["Status"] < FIX_3D:
        return None
    course = math.radians(values["GCrs"])
    velocity = np.array(
        [values["Spd"] * math.cos(course), values["Spd"] * math.sin(course), values["VZ"]]
    )
    sigma = values["HDop"] * GPS_RANGE_ERROR_M
    return GeodeticFix(
        PositionSource.GPS, values["Lat"], values["Lng"], values["Alt"], velocity, sigma
    )


def _imu(values: Values) -> Telemetry:
    gyro = _vector(values, "GyrX", "GyrY", "GyrZ")
    return ImuSample(0, gyro, _vector(values, "AccX", "AccY", "AccZ"))


def _range(values: Values) -> Telemetry | None:
    distance = values.get("Dist", values.get("Dist1", 0.0))
    down = values.get("Orient", values.get("Orient1", DOWN)) == DOWN
    good = values.get("Stat", values.get("Stat1", RANGE_GOOD)) == RANGE_GOOD
    return RangeSample(0, float(distance)) if down and good and distance > 0 else None


def _height(values: Values) -> Telemetry:
    return HeightSample(0, float(values["Alt"]))


def _armed(values: Values) -> Telemetry:
    return ArmedSample(0, bool(values["ArmState"]))


def _event(values: Values) -> Telemetry | None:
    return {EV_ARMED: ArmedSample(0, True), EV_DISARMED: ArmedSample(0, False)}.get(values["Id"])


def _gimbal(values: Values) -> Telemetry | None:
    """Angles of a gimbal, of version 4.4 and later; a yaw that it does not know is nan."""
    roll, pitch, yaw, from_north = (
        math.radians(values.get(key, math.nan)) for key in ("Roll", "Pitch", "YawB", "YawE")
    )
    if math.isfinite(roll + pitch + yaw):
        return GimbalSample(0, quaternion_from_euler(roll, pitch, yaw))
    if math.isfinite(roll + pitch + from_north):
        return GimbalSample(0, quaternion_from_euler(roll, pitch, from_north), True)
    return None


def _vector(values: Values, *keys: str) -> Array:
    return np.array([values[key] for key in keys], np.float64)


_SAMPLE_OF = {
    "POS": _global_position,
    "GPS": _gps,
    "IMU": _imu,
    "RFND": _range,
    "BARO": _height,
    "ARM": _armed,
    "EV": _event,
    "MNT": _gimbal,
}
