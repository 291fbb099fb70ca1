"""Telemetry inside a GoPro video (GPMF): that of a Karma drone's autopilot.

Without an autopilot, the positions of the camera's own receiver. Its gyroscope is used elsewhere
for time alignment (`gpmf_gyro`); its accelerometer is not read.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import compress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from companion.geometry.geodesy import STANDARD_GRAVITY_M_S2
from companion.geometry.transforms import Array, quaternion_from_euler
from companion.messages import ClockReport, Warned
from companion.telemetry import (
    AttitudeSample,
    HeightSample,
    ImuSample,
    PositionSample,
    PositionSource,
    Telemetry,
)
from companion.timing.stamp_filter import MAX_BOOT_NS, valid_stamps
from drivers.telemetry.gpmf_camera import HEIGHTS, camera_fixes
from drivers.telemetry.gpmf_records import GpmfError, read_streams
from drivers.telemetry.gpmf_track import blocks_of
from drivers.telemetry.mavlink_samples import FIX_3D, height_from_pressure
from drivers.telemetry.telemetry_log import GeodeticFix, LogContent, TelemetryCollector

Times = NDArray[np.int64]


def read_gpmf(video: Path, host_from_file_ns: Callable[[Times], Times]) -> LogContent | None:
    """Telemetry in a video; None without any.

    Autopilot time is mapped to the video's by the payloads, each of which holds the samples of its
    span of the video, then to the flight's clock by `host_from_file_ns`, given times after the
    first frame's.
    """
    payloads = blocks_of(video) if video.is_file() else []
    if not payloads:
        return None
    collected = TelemetryCollector(video.name)
    rows: list[_Row] = []
    n_damaged = 0
    for number, (_, _, payload) in enumerate(payloads):
        try:
            rows += _rows(number, payload)
        except GpmfError:
            n_damaged += 1
    good = valid_stamps([row.remote_ns for row in rows], 0, MAX_BOOT_NS)
    stamps: dict[int, list[int]] = {}
    for row in compress(rows, good):
        stamps.setdefault(row.payload, []).append(row.remote_ns)
        if row.sample is not None:
            collected.add(row.remote_ns, 0, row.sample)
    spans = [
        (payloads[number][0], payloads[number][1], min(each), max(each))
        for number, each in stamps.items()
    ]
    warnings = []
    if n_damaged:
        detail = f"{n_damaged} of {len(payloads)} blocks in {video.name}"
        warnings.append(Warned(0, "damaged telemetry", detail))
    if not spans:
        own = camera_fixes(video.name, payloads)
        if len(own):
            return LogContent(
                own, lambda file_ns, segment: host_from_file_ns(file_ns), None,
                (*warnings, HEIGHTS),
            )  # fmt: skip
        return LogContent(collected, warnings=tuple(warnings)) if warnings else None
    offset_ns, sigma_ns = _offset(spans)

    def host_ns(remote_ns: Times, segment: Times) -> Times:
        return host_from_file_ns(remote_ns + offset_ns)

    begin = host_ns(np.array([spans[0][2]]), np.zeros(1, np.int64))[0]
    report = ClockReport(
        "blocks in the video", (int(begin) - spans[0][2]) * 1e-9, 0.0, sigma_ns * 1e-6, 0
    )
    return LogContent(collected, host_ns, report, tuple(warnings))


@dataclass(frozen=True, slots=True)
class _Row:
    payload: int
    remote_ns: int
    sample: Telemetry | GeodeticFix | None


def _rows(number: int, payload: bytes) -> list[_Row]:
    out = []
    for stream in read_streams(payload):
        take = _TAKERS.get((stream.key, stream.rows.shape[1]))
        if take is not None:
            for row in stream.rows[np.isfinite(stream.rows).all(1)]:
                out.append(_Row(number, round(float(row[0]) * 1e9), take(row)))
    return out


def _offset(spans: list[tuple[int, int, int, int]]) -> tuple[int, float]:
    """Video minus autopilot time, and its sigma: each block bounds it from both sides."""
    least = max(begin - first for begin, _, first, _ in spans)
    most = min(end - last for _, end, _, last in spans)
    if least <= most:
        return (least + most) // 2, (most - least) / math.sqrt(12)
    # bounds that contradict one another: some blocks are late
    middle = np.array([(begin - first + end - last) / 2 for begin, end, first, last in spans])
    return round(float(np.median(middle))), float(max(middle.std(), (least - most) / 2))


def _attitude(row: Array) -> Telemetry:
    return AttitudeSample(0, quaternion_from_euler(*map(float, row[1:4])), row[4:7])


def _local_position(row: Array) -> Telemetry:
    return PositionSample(0, PositionSource.LOCAL, row[1:4], row[4:7])


def _global_position(row: Array) -> GeodeticFix:
    lat, lon, alt = map(float, row[1:4])
    return GeodeticFix(PositionSource.GLOBAL, lat, lon, alt, row[5:8])


def _gps(row: Array) -> GeodeticFix | None:
    if row[8] < FIX_3D:
        return None
    course = math.radians(row[7])
    velocity = np.array([row[6] * math.cos(course), row[6] * math.sin(course), math.nan])
    lat, lon, alt, horizontal_m, vertical_m = map(float, row[1:6])
    return GeodeticFix(PositionSource.GPS, lat, lon, alt, velocity, horizontal_m, vertical_m)


def _imu(row: Array) -> Telemetry:
    return ImuSample(0, row[4:7], row[1:4] * STANDARD_GRAVITY_M_S2)


def _pressure(row: Array) -> Telemetry | None:
    return HeightSample(0, height_from_pressure(float(row[1]))) if row[1] > 1e4 else None


_TAKERS: dict[tuple[str, int], Callable[[Array], Telemetry | GeodeticFix | None]] = {
    ("ATTD", 8): _attitude,
    ("LNED", 7): _local_position,
    ("GLPI", 9): _global_position,
    ("GPRI", 10): _gps,
    ("SIMU", 10): _imu,
    ("SCPR", 4): _pressure,
}
"""By key and number of fields; all begin with seconds since the autopilot's boot."""
