"""Universal Transverse Mercator projection on WGS84, and its inverse.

Krüger's series to the sixth order of the third flattening, in the form of Karney ("Transverse
Mercator with an accuracy of a few nanometers", 2011): within a zone its error is below a
micrometre.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.errors import InputError
from companion.geometry.geodesy import ECCENTRICITY_2, FLATTENING, SEMI_MAJOR_M
from companion.geometry.transforms import Array

SCALE, FALSE_EASTING_M, FALSE_NORTHING_M = 0.9996, 500_000.0, 10_000_000.0
MAX_LATITUDE_DEG, MIN_LATITUDE_DEG = 84.0, -80.0
N = FLATTENING / (2 - FLATTENING)
RADIUS_M = SEMI_MAJOR_M / (1 + N) * (1 + N**2 / 4 + N**4 / 64 + N**6 / 256)
"""Radius of the rectifying sphere."""
FORWARD = (
    N / 2 - 2 * N**2 / 3 + 5 * N**3 / 16 + 41 * N**4 / 180 - 127 * N**5 / 288 + 7891 * N**6 / 37800,
    13 * N**2 / 48 - 3 * N**3 / 5 + 557 * N**4 / 1440 + 281 * N**5 / 630 - 1983433 * N**6 / 1935360,
    61 * N**3 / 240 - 103 * N**4 / 140 + 15061 * N**5 / 26880 + 167603 * N**6 / 181440,
    49561 * N**4 / 161280 - 179 * N**5 / 168 + 6601661 * N**6 / 7257600,
    34729 * N**5 / 80640 - 3418889 * N**6 / 1995840,
    212378941 * N**6 / 319334400,
)


@dataclass(frozen=True, slots=True)
class UtmZone:
    """A zone, 1 to 60, of one hemisphere."""

    number: int
    north: bool

    @property
    def epsg(self) -> int:
        """EPSG number."""
        return (32600 if self.north else 32700) + self.number

    @property
    def name(self) -> str:
        """EPSG name."""
        return f"WGS 84 / UTM zone {self.number}{'N' if self.north else 'S'}"

    @property
    def central_meridian_deg(self) -> float:
        """Longitude of the central meridian."""
        return 6.0 * self.number - 183.0


def utm_zone(latitude_deg: float, longitude_deg: float) -> UtmZone:
    """Zone of a position, with the exceptions of Norway; InputError near the poles."""
    if not MIN_LATITUDE_DEG <= latitude_deg <= MAX_LATITUDE_DEG:
        raise InputError(f"latitude {latitude_deg:.4f} is beyond UTM; give an EPSG number")
    longitude = (longitude_deg + 180.0) % 360.0 - 180.0
    number = int((longitude + 180.0) // 6.0) + 1
    if 56.0 <= latitude_deg < 64.0 and 3.0 <= longitude < 12.0:
        number = 32
    elif latitude_deg >= 72.0 and 0.0 <= longitude < 42.0:
        number = 31 + 2 * int((longitude + 3.0) // 12.0)
    return UtmZone(number, latitude_deg >= 0)


def utm_from_geodetic(latitude_deg: Array, longitude_deg: Array, zone: UtmZone) -> Array:
    """Easting and northing (N, 2), metres, of positions (N,), possibly outside the zone."""
    latitude = np.radians(np.asarray(latitude_deg, np.float64))
    longitude_difference = np.radians(
        np.asarray(longitude_deg, np.float64) - zone.central_meridian_deg
    )
    eccentricity = np.sqrt(ECCENTRICITY_2)
    tangent = np.tan(latitude)
    sigma = np.sinh(eccentricity * np.arctanh(eccentricity * tangent / np.sqrt(1 + tangent**2)))
    conformal = tangent * np.sqrt(1 + sigma**2) - sigma * np.sqrt(1 + tangent**2)
    xi0 = np.arctan2(conformal, np.cos(longitude_difference))
    eta0 = np.arcsinh(
        np.sin(longitude_difference) / np.sqrt(conformal**2 + np.cos(longitude_difference) ** 2)
    )
    xi, eta = xi0.copy(), eta0.copy()
    for j, a in enumerate(FORWARD, 1):
        xi += a * np.sin(2 * j * xi0) * np.cosh(2 * j * eta0)
        eta += a * np.cos(2 * j * xi0) * np.sinh(2 * j * eta0)
    northing = SCALE * RADIUS_M * xi + (0.0 if zone.north else FALSE_NORTHING_M)
    return np.stack([SCALE * RADIUS_M * eta + FALSE_EASTING_M, northing], -1)
