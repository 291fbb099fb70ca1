"""Positions and velocities that were measured, by source: where the body was, and how it moved."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from companion.estimation.georeference.velocity_verdict import VelocityVerdict
from companion.estimation.sample_series import SampleSeries
from companion.geometry.transforms import Array
from companion.messages import Warned
from companion.telemetry import PositionSample, PositionSource

MAX_VELOCITY_AGE_NS = 400_000_000
"""A velocity is extrapolated for at most so long."""


class MeasuredPath:
    """Path by each source. `warn` takes changes of the verdicts on velocities."""

    def __init__(self, sensors_only: bool, warn: Callable[[Warned], None]) -> None:
        self.sources = [PositionSource.GPS] if sensors_only else list(PositionSource)
        """Those that count, the most believed first."""
        self.positions = {source: SampleSeries() for source in PositionSource}
        self._velocity_integral = {source: SampleSeries() for source in PositionSource}
        self._velocity = {source: VelocityVerdict() for source in PositionSource}
        self._warn = warn

    def take(self, sample: PositionSample) -> None:
        """Add a sample."""
        self.positions[sample.source].add(sample.t_ns, sample.position_ned_m)
        if sample.velocity_ned_m_s is not None:
            integral = self._velocity_integral[sample.source]
            self._integrate(integral, sample.t_ns, sample.velocity_ned_m_s)
            if integral.newest is not None and integral.newest[0] == sample.t_ns:
                self._judge(sample, integral.newest[1][1])

    def prune(self, before_ns: int, keyframes_ns: Array) -> None:
        """Drop samples before a time, except at the times of keyframes (N,), sorted."""
        for each in (*self.positions.values(), *self._velocity_integral.values()):
            each.prune(before_ns, keyframes_ns)

    def velocity_unproved(self, t_ns: int) -> bool:
        """True where a velocity that is wrong may have made the map too large, or turned it."""
        return any(
            self._velocity_integral[each].newest is not None and self._velocity[each].unproved(t_ns)
            for each in self.sources
        )

    @property
    def newest_place(self) -> Array | None:
        """Newest position (3,), NED metres, that may place a map; None before there is one."""
        for source in self.sources:
            newest = self.positions[source].newest
            if newest is not None:
                return np.asarray(newest[1])
        return None

    def displacement_between(self, from_ns: int, to_ns: int) -> Array | None:
        """Measured displacement (3,), NED metres, between two times; None where unknown."""
        where = self._places_at(from_ns, to_ns)
        return None if where is None else np.asarray(where[1] - where[0], np.float64)

    def place_at(self, t_ns: int) -> Array | None:
        """Measured place (3,) of the body, NED metres; None where unknown."""
        where = self._places_at(t_ns)
        return None if where is None else np.asarray(where[0], np.float64)

    def _places_at(self, *times_ns: int) -> Array | None:
        """Places (N, 3) by one source, NED metres; None where none has all of them."""
        for source in self.sources:
            if len(self.positions[source]) >= 4:
                where, ok = self.positions[source].at(np.array(times_ns))
                if ok.all():
                    return where
        return None

    def integrated_velocity(self, t_ns: Array) -> Array | None:
        """Integrated velocity (N, 3) at times (N,), NED metres.

        From one source; nan where missing. None where no source has any.
        """
        for source in self.sources:
            series = self.integral_of(source)
            if series is not None and len(series) >= 4:
                value, ok = series.at(t_ns)
                if np.count_nonzero(ok) > 1:
                    return np.where(ok[:, None], value[:, 1], np.nan)
        return None

    def displacement_by_velocity(self, from_ns: int, to_ns: int) -> Array | None:
        """Displacement (3,) by velocity, NED metres; None where unknown.

        Its down axis is nan where velocities are level ones, as some satellite receivers tell them.
        Beyond the newest sample the last velocity is held for a while.
        """
        for source in self.sources:
            series = self.integral_of(source)
            if series is None or len(series) < 2 or series.newest is None:
                continue
            newest_ns, _ = series.newest
            end_ns = min(to_ns, newest_ns)
            if to_ns - newest_ns > MAX_VELOCITY_AGE_NS or from_ns > end_ns:
                continue
            (start, end), ok = series.at(np.array([from_ns, end_ns]))
            if ok.all():
                travelled_m = end[1] - start[1] + end[0] * ((to_ns - end_ns) * 1e-9)
                return np.asarray(travelled_m, np.float64)
        return None

    def _integrate(self, series: SampleSeries, t_ns: int, velocity: Array) -> None:
        # rows: velocity and its integral; a GPS may lack the vertical component
        if not series.takes(t_ns):
            return
        if series.newest is None:
            series.add(t_ns, np.stack([velocity, 0.0 * velocity]), horizontal_only=True)
            return
        before_ns, (previous, travelled_m) = series.newest
        dt = (t_ns - before_ns) * 1e-9
        integrated_velocity = travelled_m + 0.5 * (previous + velocity) * dt
        series.add(t_ns, np.stack([velocity, integrated_velocity]), horizontal_only=True)

    def _judge(self, sample: PositionSample, travelled_m: Array) -> None:
        verdict = self._velocity[sample.source]
        change = verdict.take(sample.t_ns, sample.position_ned_m, travelled_m)
        if change is not None and sample.source in self.sources:
            self._warn(replace(change, detail=f"{sample.source.value}: {change.detail}"))

    def integral_of(self, source: PositionSource) -> SampleSeries | None:
        """Integrated velocity of a source; None where it is not believed."""
        return self._velocity_integral[source] if self._velocity[source].believed else None
