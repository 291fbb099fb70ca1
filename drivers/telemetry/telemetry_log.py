"""Output of log readers, with times and positions brought to one clock and origin.

A reader collects samples on the autopilot's clock and positions as given;
`TelemetryCollector.finish` puts all of them on the flight's clock and about one origin.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.geometry.geodesy import GeoOrigin, ned_from_geodetic, origin_of
from companion.geometry.transforms import Array
from companion.messages import ClockReport, Warned
from companion.telemetry import (
    AttitudeSample,
    GimbalSample,
    ImuSample,
    PositionSample,
    PositionSource,
    Telemetry,
)

PAIR_NS = 100_000_000
"""Largest time difference of local and global positions that give the local origin."""
MAX_PAIRS = 200
HostTimes = Callable[[NDArray[np.int64], NDArray[np.int64]], NDArray[np.int64]]


@dataclass(frozen=True, slots=True)
class Pictures:
    """Time span of a flight's images, and their file with its own clock."""

    path: Path
    start_ns: int
    stop_ns: int
    host_from_file_ns: Callable[[NDArray[np.int64]], NDArray[np.int64]]


@dataclass(frozen=True, slots=True, eq=False)
class TelemetryLog:
    """All samples of a flight, sorted by time on the flight's clock.

    `rates_hz` is by kind of sample, positions by source. `clock` is None where the log needs none
    or states nothing; `origin` is None where unknown.
    """

    source: str
    samples: Sequence[Telemetry]
    clock: ClockReport | None = None
    origin: GeoOrigin | None = None
    warnings: tuple[Warned, ...] = ()
    rates_hz: Mapping[str, float] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    """Remarks for the user on how it was read."""


def no_telemetry(pictures: Pictures) -> TelemetryLog:
    """Log of a flight that has none."""
    missing = Warned(pictures.start_ns, "no telemetry", "neither scale nor level will be known")
    return TelemetryLog("", (), warnings=(missing,))


@dataclass(frozen=True, slots=True, eq=False)
class GeodeticFix:
    """Geodetic position of a log; its stamp is kept beside it."""

    source: PositionSource
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    velocity_ned_m_s: Array | None = None
    sigma_horizontal_m: float | None = None
    sigma_vertical_m: float | None = None


@dataclass(slots=True)
class TelemetryCollector:
    """Takes samples with stamps of the autopilot; their own `t_ns` is ignored."""

    source: str
    origin: dict[int, GeoOrigin] = field(default_factory=dict)
    """By segment, where the log states it."""
    _stamps: list[tuple[int, int]] = field(default_factory=list)
    _content: list[Telemetry | GeodeticFix] = field(default_factory=list)
    _unusable: Counter[str] = field(default_factory=Counter)

    def add(self, remote_ns: int, segment: int, content: Telemetry | GeodeticFix) -> None:
        """Add a sample, unless a number in it is not finite."""
        if not is_finite(content):
            self.count("telemetry with values that are no numbers left out")
            return
        self._stamps.append((remote_ns, segment))
        self._content.append(content)

    def count(self, what: str) -> None:
        """Count an error in the log."""
        self._unusable[what] += 1

    def __len__(self) -> int:
        return len(self._content)

    def stamps(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Autopilot times and segments of all samples so far."""
        table = np.array(self._stamps, np.int64).reshape(-1, 2)
        return table[:, 0], table[:, 1]

    def finish(
        self,
        host_ns: HostTimes,
        clock: ClockReport | None,
        warnings: Sequence[Warned] = (),
        on_host_clock: Sequence[Telemetry] = (),
    ) -> TelemetryLog:
        """Log on the flight's clock and about one origin; `on_host_clock` already was."""
        times = host_ns(*self.stamps())
        order = np.argsort(times, kind="stable")
        stamped = [(int(times[i]), self._stamps[i][1], self._content[i]) for i in order]
        origins = {**_origins_by_pairs(stamped), **self.origin}
        home = origins[min(origins)] if origins else _first_place(stamped)
        samples = [
            _placed(t_ns, content, origins.get(segment), home) for t_ns, segment, content in stamped
        ]
        samples = sorted([*samples, *on_host_clock], key=lambda sample: sample.t_ns)
        first_ns = samples[0].t_ns if samples else 0
        counted = tuple(Warned(first_ns, what, f"{n} times") for what, n in self._unusable.items())
        return TelemetryLog(
            self.source, samples, clock, home, (*warnings, *counted), rates_hz(samples)
        )


def rates_hz(samples: Sequence[Telemetry]) -> dict[str, float]:
    """Mean rate of each kind of sample over the time from its first to its last."""
    times: dict[str, list[int]] = {}
    for sample in samples:
        times.setdefault(kind_of(sample), []).append(sample.t_ns)
    return {
        kind: round((len(t) - 1) / ((t[-1] - t[0]) * 1e-9), 2) if t[-1] > t[0] else 0.0
        for kind, t in sorted(times.items())
    }


def kind_of(sample: Telemetry) -> str:
    """Kind of a sample, in words."""
    if isinstance(sample, PositionSample):
        return sample.source.value
    return sample.schema.name


def is_finite(content: Telemetry | GeodeticFix) -> bool:
    """True if all its numbers are finite."""
    # written out, since this runs for every sample of a flight
    if isinstance(content, AttitudeSample):
        return _are_finite(content.ned_from_body)
    if isinstance(content, GimbalSample):
        return _are_finite(content.level_from_head)
    if isinstance(content, ImuSample):
        return _are_finite(content.gyro_rad_s) and _are_finite(content.accel_m_s2)
    if isinstance(content, PositionSample):
        return _are_finite(content.position_ned_m)
    return all(
        math.isfinite(value)
        for name in content.__slots__
        if isinstance(value := getattr(content, name), float)
    )


def _are_finite(few: Array) -> bool:
    """True if all of a few numbers are; numpy's own takes three times as long for these."""
    return all(map(math.isfinite, few.tolist()))


def _origins_by_pairs(stamped: Sequence[tuple[int, int, Any]]) -> dict[int, GeoOrigin]:
    """Origins of local positions by segment, from global ones of the same time."""
    local: dict[int, list[tuple[int, Array]]] = {}
    fixes: dict[int, list[tuple[int, GeodeticFix]]] = {}
    for t_ns, segment, content in stamped:
        if isinstance(content, PositionSample) and content.source is PositionSource.LOCAL:
            local.setdefault(segment, []).append((t_ns, content.position_ned_m))
        elif isinstance(content, GeodeticFix) and content.source is PositionSource.GLOBAL:
            fixes.setdefault(segment, []).append((t_ns, content))
    out = {}
    for segment in local.keys() & fixes.keys():
        t_local = np.array([t_ns for t_ns, _ in local[segment]])
        positions = np.stack([position for _, position in local[segment]])
        found = []
        step = max(1, len(fixes[segment]) // MAX_PAIRS)
        for t_ns, fix in fixes[segment][::step]:
            after = int(np.searchsorted(t_local, t_ns))
            near = max(0, after - 1), min(len(t_local) - 1, after)
            if max(abs(int(t_local[k]) - t_ns) for k in near) > PAIR_NS:
                continue
            times = t_local[list(near)] - t_ns
            here = np.array([np.interp(0, times, positions[near, axis]) for axis in range(3)])
            found.append(origin_of(fix.latitude_deg, fix.longitude_deg, fix.altitude_m, here))
        if found:
            middle = np.median([dataclasses.astuple(origin) for origin in found], axis=0)
            out[segment] = GeoOrigin(*map(float, middle))
    return out


def _first_place(stamped: Sequence[tuple[int, int, Any]]) -> GeoOrigin | None:
    for source in (PositionSource.GLOBAL, PositionSource.GPS):
        for _, _, content in stamped:
            if isinstance(content, GeodeticFix) and content.source is source:
                return GeoOrigin(content.latitude_deg, content.longitude_deg, content.altitude_m)
    return None


def _placed(
    t_ns: int, content: Telemetry | GeodeticFix, origin: GeoOrigin | None, home: GeoOrigin | None
) -> Telemetry:
    if isinstance(content, GeodeticFix):
        assert home is not None
        ned = ned_from_geodetic(
            content.latitude_deg, content.longitude_deg, content.altitude_m, home
        )
        return PositionSample(
            t_ns, content.source, ned, content.velocity_ned_m_s,
            content.sigma_horizontal_m, content.sigma_vertical_m,
        )  # fmt: skip
    if isinstance(content, PositionSample) and origin is not None and origin is not home:
        assert home is not None
        moved = ned_from_geodetic(
            origin.latitude_deg, origin.longitude_deg, origin.altitude_m, home
        )
        return dataclasses.replace(
            content, t_ns=t_ns, position_ned_m=content.position_ned_m + moved
        )
    return dataclasses.replace(content, t_ns=t_ns)


@dataclass(frozen=True, slots=True, eq=False)
class LogContent:
    """Content of a log: samples, and the mapping of their times to the flight's clock.

    `host_ns` is None where the log has no absolute time. `on_host_clock` are samples that are on
    the flight's clock already.
    """

    collected: TelemetryCollector
    host_ns: HostTimes | None = None
    clock: ClockReport | None = None
    warnings: tuple[Warned, ...] = ()
    on_host_clock: tuple[Telemetry, ...] = ()
