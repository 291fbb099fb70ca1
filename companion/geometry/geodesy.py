"""Conversion between geodetic coordinates and local NED (WGS84 ellipsoid)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.geometry.transforms import Array

SEMI_MAJOR_M = 6378137.0
FLATTENING = 1 / 298.257223563
ECCENTRICITY_2 = FLATTENING * (2 - FLATTENING)
STANDARD_GRAVITY_M_S2 = 9.80665
"""By the 3rd CGPM, 1901; on earth it is within 0.3 % of this."""


@dataclass(frozen=True, slots=True)
class GeoOrigin:
    """Origin of local NED (WGS84; altitude above mean sea level)."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float


def ned_from_geodetic(
    latitude_deg: float, longitude_deg: float, altitude_m: float, origin: GeoOrigin
) -> Array:
    """Position (3,) in the tangent frame at `origin`; the geoid is assumed level there."""
    ecef = _ecef(latitude_deg, longitude_deg, altitude_m)
    zero = _ecef(origin.latitude_deg, origin.longitude_deg, origin.altitude_m)
    ned: Array = _ned_from_ecef(origin.latitude_deg, origin.longitude_deg) @ (ecef - zero)
    return ned


def geodetic_from_ned(points_ned_m: Array, origin: GeoOrigin) -> Array:
    """Latitude, longitude (degrees) and altitude (m) (N, 3) of positions (N, 3) in NED at `origin`.

    The exact inverse of `ned_from_geodetic`, to micrometres (Bowring 1976, iterated).
    """
    rotation = _ned_from_ecef(origin.latitude_deg, origin.longitude_deg)
    zero = _ecef(origin.latitude_deg, origin.longitude_deg, origin.altitude_m)
    x, y, z = (np.asarray(points_ned_m, np.float64) @ rotation + zero).T
    equatorial_m = np.hypot(x, y)
    semi_minor_m = SEMI_MAJOR_M * (1 - FLATTENING)
    second = ECCENTRICITY_2 / (1 - ECCENTRICITY_2)
    reduced = np.arctan2(z, equatorial_m * (1 - FLATTENING))
    latitude = np.zeros_like(reduced)
    for _ in range(3):
        latitude = np.arctan2(
            z + second * semi_minor_m * np.sin(reduced) ** 3,
            equatorial_m - ECCENTRICITY_2 * SEMI_MAJOR_M * np.cos(reduced) ** 3,
        )
        reduced = np.arctan2((1 - FLATTENING) * np.sin(latitude), np.cos(latitude))
    sine, cosine = np.sin(latitude), np.cos(latitude)
    radius_m = SEMI_MAJOR_M / np.sqrt(1 - ECCENTRICITY_2 * sine**2)
    # this form is well-conditioned at the poles and the equator
    altitude = equatorial_m * cosine + z * sine - radius_m * (1 - ECCENTRICITY_2 * sine**2)
    return np.stack([np.degrees(latitude), np.degrees(np.arctan2(y, x)), altitude], 1)


def earth_from_ned(origin: GeoOrigin) -> tuple[Array, Array]:
    """Zero (3,) and unit axes (3, 3), rows north, east, down, of local NED in ECEF metres."""
    zero = _ecef(origin.latitude_deg, origin.longitude_deg, origin.altitude_m)
    return zero, _ned_from_ecef(origin.latitude_deg, origin.longitude_deg)


def origin_of(
    latitude_deg: float, longitude_deg: float, altitude_m: float, position_ned_m: Array
) -> GeoOrigin:
    """Origin of the local NED in which a geodetic position has the given coordinates.

    Accurate to millimetres within some kilometres: the curvature is evaluated at the position.
    """
    here = GeoOrigin(latitude_deg, longitude_deg, altitude_m)
    for _ in range(3):
        error = ned_from_geodetic(latitude_deg, longitude_deg, altitude_m, here) - position_ned_m
        sine = np.sin(np.radians(here.latitude_deg))
        shrink = 1 - ECCENTRICITY_2 * sine**2
        north_m = SEMI_MAJOR_M * (1 - ECCENTRICITY_2) / shrink**1.5
        east_m = SEMI_MAJOR_M / np.sqrt(shrink) * np.cos(np.radians(here.latitude_deg))
        here = GeoOrigin(
            here.latitude_deg + float(np.degrees(error[0] / north_m)),
            here.longitude_deg + float(np.degrees(error[1] / east_m)),
            here.altitude_m - float(error[2]),
        )
    return here


def _ecef(latitude_deg: float, longitude_deg: float, altitude_m: float) -> NDArray[np.float64]:
    lat, lon = np.radians(latitude_deg), np.radians(longitude_deg)
    equatorial_m = SEMI_MAJOR_M / np.sqrt(1 - ECCENTRICITY_2 * np.sin(lat) ** 2)
    out = np.array([
        (equatorial_m + altitude_m) * np.cos(lat) * np.cos(lon),
        (equatorial_m + altitude_m) * np.cos(lat) * np.sin(lon),
        (equatorial_m * (1 - ECCENTRICITY_2) + altitude_m) * np.sin(lat),
    ])  # fmt: skip
    return out


def _ned_from_ecef(latitude_deg: float, longitude_deg: float) -> Array:
    lat, lon = np.radians(latitude_deg), np.radians(longitude_deg)
    sa, ca, so, co = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    return np.array([[-sa * co, -sa * so, ca], [-so, co, 0.0], [-ca * co, -ca * so, -sa]])
