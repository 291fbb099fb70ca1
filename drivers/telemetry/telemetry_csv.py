"""Telemetry table `telemetry.csv`: on the flight's clock, about one origin, nothing rounded.

A line is `unix_ns,kind,values`; what a sample does not have is empty. Comments before hold the
origin, how the clocks were put together, and warnings about the source of the samples. The kind is
the name of the sample's schema, of a position its source; the values are its fields in order
(companion/telemetry.py), arrays spread out, flags as 0 or 1, some only where they are true.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from companion.errors import FlightError
from companion.geometry.geodesy import GeoOrigin
from companion.messages import ClockReport, Warned
from companion.sample_schema import Field
from companion.telemetry import FIELDS, TELEMETRY, PositionSample, PositionSource, Telemetry
from drivers.telemetry.telemetry_log import LogContent, TelemetryCollector, TelemetryLog, kind_of

NAME = "telemetry.csv"
HEADER = "unix_ns,kind,values"
WARNING = "# warning"
KINDS: dict[str, type[Telemetry]] = {
    **{kind.schema.name: kind for kind in TELEMETRY if kind is not PositionSample},
    **{source.value: PositionSample for source in PositionSource},
}
WIDTHS: dict[str, int] = {
    name: sum(f.size or 1 for f in FIELDS[kind] if f.words is None and not f.where_true)
    for name, kind in KINDS.items()
}
"""Number of values of each kind, without a flag that is written only where it is true."""
MOST: dict[str, int] = {
    name: WIDTHS[name] + sum(f.where_true for f in FIELDS[kind]) for name, kind in KINDS.items()
}
"""The same with it."""


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


def _values(sample: Telemetry) -> Iterator[float | None]:
    for field in FIELDS[type(sample)]:
        value = getattr(sample, field.name)
        if field.size is not None:
            yield from [None] * field.size if value is None else value
        elif field.words is None and (value or not field.where_true):
            yield value


def _sample(words: list[str]) -> Telemetry | None:
    if len(words) < 3 or words[1] not in KINDS:
        return None
    if not WIDTHS[words[1]] <= len(words) - 2 <= MOST[words[1]]:
        return None
    try:
        t_ns = int(words[0])
        numbers = [float(word) if word else None for word in words[2:]]
    except ValueError:
        return None
    if not 0 <= t_ns < 2**62:
        return None
    kind, rest = KINDS[words[1]], iter(numbers)
    return kind(t_ns=t_ns, **{f.name: _value(f, words[1], rest) for f in FIELDS[kind]})


def _value(field: Field, kind: str, rest: Iterator[float | None]) -> Any:
    """Value of a field by the kind or the next numbers of a line."""
    if field.words is not None:
        return field.words(kind)
    numbers = list(islice(rest, field.size or 1))
    if field.where_true:
        return numbers == [1.0]
    if numbers[0] is None and field.may_lack:
        return None
    if field.size is not None:
        return np.array(numbers, np.float64)
    return numbers[0] == 1 if field.is_flag else math.nan if numbers[0] is None else numbers[0]


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
