"""Map coordinates of a run: UTM, a given projection, or a local frame.

Axes are east, north, up. Heights are the autopilot's, above mean sea level: by the geoid of its GPS
receiver, which for most is EGM96.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.enums import WktVersion
from pyproj.exceptions import CRSError

from companion.errors import InputError
from companion.geometry.geodesy import GeoOrigin, geodetic_from_ned
from companion.geometry.transforms import Array, nearest_rotation

UTM_NORTH, UTM_SOUTH = 32600, 32700
"""EPSG numbers of zones, less their own numbers: UTM on WGS84."""
EGM96 = 5773
MAX_LATITUDE_DEG, MIN_LATITUDE_DEG = 84.0, -80.0


@dataclass(frozen=True, slots=True, eq=False)
class MapFrame:
    """East, north and height (N, 3) of points (N, 3) in local NED; `wkt` is "" for a local frame.

    `wkt` is of the plane, `wkt_with_height` of the heights too if they are above mean sea level,
    both as OGC WKT 1.
    """

    name: str
    epsg: int | None
    wkt: str
    wkt_with_height: str
    coordinates: Callable[[Array], Array]

    def directions(self, vectors_ned: NDArray[np.floating], about: NDArray[np.floating]) -> Array:
        """Unit vectors (N, 3) in local NED, or zeros, in this frame.

        Grid north is not true north: the rotation is that at the mean of points `about` (N, 3).
        """
        if len(vectors_ned) == 0:
            return np.zeros((0, 3))
        middle = about.astype(np.float64).mean(0)
        there = self.coordinates(middle + np.vstack([np.zeros(3), 10.0 * np.eye(3)]))
        turned = vectors_ned.astype(np.float64) @ nearest_rotation((there[1:] - there[0]) / 10.0)
        return np.asarray(turned)


def map_frame(
    origin: GeoOrigin | None, metric: bool, epsg: int, above_sea: bool = True
) -> MapFrame:
    """The frame with this EPSG number; by 0 the UTM zone of the origin, or without one local.

    Where not `metric` the map's own axes are kept. `above_sea` tells whether heights are above mean
    sea level. InputError where there is no such projection in metres, or no origin for it.
    """
    if origin is None:
        if epsg:
            raise InputError(
                f"EPSG:{epsg} cannot be had: no place on Earth is known of this run (its report "
                "says why); leave the number out for local coordinates"
            )
        if not metric:
            return MapFrame("the map's own axes and units", None, "", "", _same)
        return MapFrame("local east, north, up in metres", None, "", "", _enu)
    epsg = epsg or utm_epsg(origin.latitude_deg, origin.longitude_deg)
    try:
        crs = CRS.from_epsg(epsg)
    except CRSError as error:
        raise InputError(f"EPSG:{epsg}: there is no such coordinate system") from error
    units = {axis.unit_name for axis in crs.axis_info}
    if not crs.is_projected or units != {"metre"} or len(crs.axis_info) != 2:
        raise InputError(f"EPSG:{epsg} ({crs.name}) is no flat projection in metres")
    transformer = Transformer.from_crs(4326, crs, always_xy=True)

    def coordinates(points_ned: Array) -> Array:
        places = geodetic_from_ned(points_ned, origin)
        east, north = transformer.transform(places[:, 1], places[:, 0])
        out = np.column_stack([east, north, places[:, 2]])
        if not np.isfinite(out).all():
            raise InputError(f"EPSG:{epsg} ({crs.name}) does not reach to where the flight was")
        return out

    with_heights = CRS.from_user_input(f"EPSG:{epsg}+{EGM96}") if above_sea else crs
    return MapFrame(
        crs.name, epsg, crs.to_wkt(WktVersion.WKT1_GDAL),
        with_heights.to_wkt(WktVersion.WKT1_GDAL), coordinates,
    )  # fmt: skip


def utm_epsg(latitude_deg: float, longitude_deg: float) -> int:
    """EPSG number of the UTM zone, with the exceptions of Norway; InputError near the poles."""
    if not MIN_LATITUDE_DEG <= latitude_deg <= MAX_LATITUDE_DEG:
        raise InputError(f"latitude {latitude_deg:.4f} is beyond UTM; give an EPSG number")
    longitude = (longitude_deg + 180.0) % 360.0 - 180.0
    number = int((longitude + 180.0) // 6.0) + 1
    if 56.0 <= latitude_deg < 64.0 and 3.0 <= longitude < 12.0:
        number = 32
    elif latitude_deg >= 72.0 and 0.0 <= longitude < 42.0:
        number = 31 + 2 * int((longitude + 3.0) // 12.0)
    return number + (UTM_NORTH if latitude_deg >= 0 else UTM_SOUTH)


def _enu(points_ned: Array) -> Array:
    return np.asarray(points_ned, np.float64)[:, [1, 0, 2]] * [1, 1, -1]


def _same(points: Array) -> Array:
    return np.asarray(points, np.float64)
