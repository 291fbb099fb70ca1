"""Positions of a GoPro camera's own GPS receiver, from the same track as an autopilot's telemetry.

A block of the track holds the samples of its span of the video, evenly spread (GPS5: latitude,
longitude, height, speeds; with GPSF, the kind of fix, and GPSP, its dilution. GPS9, of later
cameras: the same with these two in each row).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from companion.geometry.transforms import Array
from companion.messages import Warned
from companion.telemetry import PositionSource
from drivers.telemetry.gpmf_records import GpmfError, read_streams
from drivers.telemetry.telemetry_log import GeodeticFix, TelemetryCollector

FIX_3D = 3.0
METRES_PER_DILUTION = 3.0
"""Typical error of a receiver at dilution 1."""
MAX_DILUTION = 10.0
HEIGHTS = Warned(0, "heights of the camera's receiver", "may be above the ellipsoid, not the sea")


def camera_fixes(name: str, payloads: Sequence[tuple[int, int, bytes]]) -> TelemetryCollector:
    """Positions with times of the video; `payloads` are begin and end in ns, and content."""
    collected = TelemetryCollector(name)
    for begin_ns, end_ns, payload in payloads:
        try:
            streams = {stream.key: stream.rows for stream in read_streams(payload)}
        except GpmfError:
            continue  # counted where the track is read
        rows, fix, dilution = _rows(streams)
        step_ns = (end_ns - begin_ns) / max(len(rows), 1)
        for k, row in enumerate(rows):
            place = float(row[0]), float(row[1]), float(row[2])
            believable = abs(place[0]) <= 90 and abs(place[1]) <= 180 and np.isfinite(row).all()
            if believable and fix[k] >= FIX_3D and 0 < dilution[k] <= MAX_DILUTION:
                sigma_m = METRES_PER_DILUTION * float(dilution[k])
                at_ns = begin_ns + round((k + 0.5) * step_ns)
                collected.add(
                    at_ns, 0, GeodeticFix(PositionSource.GPS, *place, None, sigma_m, 2 * sigma_m)
                )
    return collected


def _rows(streams: Mapping[str, Array]) -> tuple[Array, Array, Array]:
    """Rows, the kind of fix of each, and its dilution of precision."""
    rows = streams.get("GPS9", np.zeros((0, 9)))
    if rows.ndim == 2 and len(rows) and rows.shape[1] == 9:
        return rows, rows[:, 8], rows[:, 7]
    rows = streams.get("GPS5", np.zeros((0, 5)))
    if rows.ndim != 2 or rows.shape[1] != 5:
        rows = np.zeros((0, 5))
    fix = streams.get("GPSF", np.zeros((1, 1)))
    dilution = streams.get("GPSP", np.full((1, 1), 9999.0)) / 100
    n = len(rows)
    return rows, np.full(n, float(fix[0, 0])), np.full(n, float(dilution[0, 0]))
