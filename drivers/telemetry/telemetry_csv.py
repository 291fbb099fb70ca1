"""Telemetry table `telemetry.csv`: on the flight's clock, about one origin, nothing rounded.

A line is `unix_ns,kind,values`; what a sample does not have is empty. Comments before hold the
origin, how the clocks were put together, and warnings about the source of the samples.

| kind | values |
|---|---|
| attitude | w x y z, ned from body; body rates, rad/s |
| imu | gyro, rad/s; accelerometer, m/s2 |
| local position, global position, GPS | north east down, m; velocity, m/s; sigmas, m |
| range, height | m |
| armed | 0 or 1 |
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from companion.errors import FlightError
from companion.geometry.geodesy import GeoOrigin
from companion.messages import (
    ArmedSample,
    AttitudeSample,
    ClockReport,
    HeightSample,
    ImuSample,
    PositionSample,
    PositionSource,
    RangeSample,
    Telemetry,
    Warned,
)
from drivers.telemetry.telemetry_log import LogContent, TelemetryCollector, TelemetryLog, kind_of

NAME = "telemetry.csv"
HEADER = "unix_ns,kind,values"
WARNING = "# warning"
SOURCES = {source.value: source for source in PositionSource}
WIDTHS = {"attitude": 7, "imu": 6, "range": 1, "height": 1, "armed": 1, **dict.fromkeys(SOURCES, 8)}


def telemetry_csv(log: TelemetryLog, warnings: Sequence[Warned] = ()) -> Iterator[str]:
    """Lines of the table; `warnings` are added to the log's own."""
    if log.origin is not None:
        yield "# origin," + ",".join(map(repr, dataclasses.astuple(log.origin))) + "\n"
    if log.clock is not None:
        c = log.clock
        numbers = f"{c.offset_s!r},{c.drift_ppm!r},{c.sigma_ms!r},{c.n_reboots}"
        yield f"# clock,{c.method.replace(',', ' ')},{numbers}\n"
    for warned in (*warnings, *log.warnings):
        yield f"{WARNING},{warned.t_ns},{json.dumps([warned.what, warned.detail])}\n"
    yield HEADER + "\n"
    for sample in log.samples:
        values = ",".join("" if v is None else repr(float(v)) for v in _values(sample))
        yield f"{sample.t_ns},{kind_of(sample)},{values}\n"


def read_telemetry_csv(path: Path) -> LogContent:
    """Read such a table; FlightError for any other. Damaged lines are counted."""
    collected = TelemetryCollector(path.name)
    clock: ClockReport | None = None
    warnings: list[Warned] = []
    with path.open(encoding="utf-8", errors="replace") as lines:
        begun = False
        for line in lines:
            words = line.rstrip("\n").split(",")
            if not begun:
                begun = line.rstrip("\n") == HEADER
                origin = _origin(words)
                if origin is not None:
                    collected.origin[0] = origin
                clock = _clock(words) or clock
                warnings += _warning(line)
                if not begun and not line.startswith("#"):
                    break
                continue
            read = _sample(words)
            if read is None:
                collected.count("damaged lines of telemetry.csv left out")
            else:
                collected.add(read.t_ns, 0, read)
    if not begun:
        raise FlightError(f'{path}: wanted a line "{HEADER}" after the comments')
    return LogContent(collected, lambda remote_ns, segment: remote_ns, clock, tuple(warnings))


def _values(sample: Telemetry) -> list[float | None]:
    if isinstance(sample, AttitudeSample):
        rates = sample.rates_body_rad_s
        return [*sample.ned_from_body, *([None] * 3 if rates is None else rates)]
    if isinstance(sample, ImuSample):
        return [*sample.gyro_rad_s, *sample.accel_m_s2]
    if isinstance(sample, PositionSample):
        velocity = sample.velocity_ned_m_s
        return [
            *sample.position_ned_m, *([None] * 3 if velocity is None else velocity),
            sample.sigma_horizontal_m, sample.sigma_vertical_m,
        ]  # fmt: skip
    if isinstance(sample, RangeSample):
        return [sample.distance_m]
    return [sample.height_m if isinstance(sample, HeightSample) else float(sample.armed)]


def _sample(words: list[str]) -> Telemetry | None:
    if len(words) < 3 or len(words) - 2 != WIDTHS.get(words[1]):
        return None
    kind = words[1]
    try:
        t_ns = int(words[0])
        values = np.array([float(word) if word else np.nan for word in words[2:]])
    except ValueError:
        return None
    if not 0 <= t_ns < 2**62:
        return None
    first = values[:3]
    if kind == "attitude":
        return AttitudeSample(t_ns, values[:4], None if words[6] == "" else values[4:])
    if kind == "imu":
        return ImuSample(t_ns, first, values[3:])
    if kind in SOURCES:
        horizontal, vertical = (None if w == "" else float(w) for w in words[8:10])
        return PositionSample(
            t_ns, SOURCES[kind], first, None if words[5] == "" else values[3:6],
            horizontal, vertical,
        )  # fmt: skip
    if kind == "range":
        return RangeSample(t_ns, float(values[0]))
    if kind == "height":
        return HeightSample(t_ns, float(values[0]))
    return ArmedSample(t_ns, bool(values[0] == 1))


def _origin(words: list[str]) -> GeoOrigin | None:
    if words[0] != "# origin" or len(words) != 4:
        return None
    try:
        origin = GeoOrigin(*map(float, words[1:]))
    except ValueError:
        return None
    believable = abs(origin.latitude_deg) <= 90 and abs(origin.longitude_deg) <= 180
    return origin if believable and abs(origin.altitude_m) < 1e5 else None


def _warning(line: str) -> list[Warned]:
    """Warning of such a line; none of another."""
    name, _, rest = line.partition(",")
    t_ns, _, said = rest.partition(",")
    if name != WARNING or not (t_ns.isascii() and t_ns.isdigit() and len(t_ns) < 20):
        return []
    try:
        what, detail = json.loads(said)
    except (ValueError, TypeError, RecursionError):
        return []
    return [Warned(int(t_ns), str(what), str(detail))]


def _clock(words: list[str]) -> ClockReport | None:
    if words[0] != "# clock" or len(words) != 6:
        return None
    try:
        offset_s, drift_ppm, sigma_ms = map(float, words[2:5])
        return ClockReport(words[1], offset_s, drift_ppm, sigma_ms, int(words[5]))
    except ValueError:
        return None
