"""Positions of a live autopilot about one origin, as they come.

The live counterpart of `TelemetryCollector.finish`, without knowledge of later samples: the origin
is that of the autopilot's local frame, if stated or if positions in both frames give it, and
otherwise the first geodetic position. Once known it stays; after a reboot, which gives the
autopilot another origin, local positions are moved to the old one.
"""

from __future__ import annotations

import dataclasses

from companion.geometry.geodesy import GeoOrigin, ned_from_geodetic, origin_of
from companion.geometry.transforms import Array
from companion.telemetry import PositionSample, PositionSource
from drivers.telemetry.telemetry_log import PAIR_NS, GeodeticFix

WAIT_NS = 2_000_000_000
"""Time that a fix waits for an origin before it becomes the origin itself."""
SAME_M = 0.5
"""Origins closer than this are the same, with different rounding."""


class LivePositions:
    """Takes positions in order of time; `remote_ns` is the autopilot's, within one boot."""

    def __init__(self) -> None:
        self.home: GeoOrigin | None = None
        """Origin of all positions; None while no geodetic position is known."""
        self.origin: GeoOrigin | None = None
        """Present origin of the autopilot's local frame."""
        self._local: tuple[int, Array, Array | None] | None = None
        self._first_fix_ns: int | None = None

    def restart(self) -> None:
        """The autopilot has rebooted."""
        self.origin = self._local = self._first_fix_ns = None

    def set_origin(self, origin: GeoOrigin) -> None:
        """Take the origin of its local frame, as stated by the autopilot."""
        if self.origin is not None and _distance_m(self.origin, origin) < SAME_M:
            return
        self._set_origin(origin)

    def local(self, sample: PositionSample, remote_ns: int) -> PositionSample | None:
        """A local position; None while the offset of its frame to the one before is unknown."""
        self._local = remote_ns, sample.position_ned_m, sample.velocity_ned_m_s
        if self.home is None or self.home is self.origin:
            return sample
        if self.origin is None:
            return None
        o = self.origin
        moved = ned_from_geodetic(o.latitude_deg, o.longitude_deg, o.altitude_m, self.home)
        return dataclasses.replace(sample, position_ned_m=sample.position_ned_m + moved)

    def fix(self, fix: GeodeticFix, remote_ns: int) -> PositionSample | None:
        """A geodetic position; None while there is no origin."""
        if self._first_fix_ns is None:
            self._first_fix_ns = remote_ns
        waited = remote_ns - self._first_fix_ns >= WAIT_NS
        if self.origin is None and (fix.source is PositionSource.GLOBAL or waited):
            here = self._local_at(remote_ns)
            if here is not None:
                self._set_origin(
                    origin_of(fix.latitude_deg, fix.longitude_deg, fix.altitude_m, here)
                )
        if self.home is None and waited:
            self.home = GeoOrigin(fix.latitude_deg, fix.longitude_deg, fix.altitude_m)
        if self.home is None:
            return None
        return PositionSample(
            0, fix.source,
            ned_from_geodetic(fix.latitude_deg, fix.longitude_deg, fix.altitude_m, self.home),
            fix.velocity_ned_m_s, fix.sigma_horizontal_m, fix.sigma_vertical_m,
        )  # fmt: skip

    def _set_origin(self, origin: GeoOrigin) -> None:
        if self.home is not None and _distance_m(self.home, origin) < SAME_M:
            origin = self.home
        self.origin = origin
        if self.home is None:
            self.home = origin

    def _local_at(self, remote_ns: int) -> Array | None:
        """Newest local position, extrapolated to a time near it."""
        if self._local is None or abs(remote_ns - self._local[0]) > PAIR_NS:
            return None
        at_ns, position, velocity = self._local
        if velocity is None:
            return position
        moved: Array = position + velocity * ((remote_ns - at_ns) * 1e-9)
        return moved


def _distance_m(a: GeoOrigin, b: GeoOrigin) -> float:
    x, y, z = ned_from_geodetic(b.latitude_deg, b.longitude_deg, b.altitude_m, a)
    return float((x * x + y * y + z * z) ** 0.5)
