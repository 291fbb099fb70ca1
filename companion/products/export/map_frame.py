"""Map coordinates of a run: UTM, a given projection, or a local frame.

Axes are east, north, up. Heights are the autopilot's, above mean sea level: by the geoid of its GPS
receiver, which for most is EGM96.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.errors import InputError
from companion.geometry.geodesy import GeoOrigin, geodetic_from_ned
from companion.geometry.transforms import Array, nearest_rotation
from companion.geometry.utm import UtmZone, utm_from_geodetic, utm_zone

WGS84 = (
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563,'
    'AUTHORITY["EPSG","7030"]],AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0,'
    'AUTHORITY["EPSG","8901"]],UNIT["degree",0.0174532925199433,AUTHORITY["EPSG","9122"]],'
    'AUTHORITY["EPSG","4326"]]'
)
EGM96 = (
    'VERT_CS["EGM96 height",VERT_DATUM["EGM96 geoid",2005,AUTHORITY["EPSG","5171"]],'
    'UNIT["metre",1,AUTHORITY["EPSG","9001"]],AXIS["Gravity-related height",UP],'
    'AUTHORITY["EPSG","5773"]]'
)


@dataclass(frozen=True, slots=True, eq=False)
class MapFrame:
    """East, north and height (N, 3) of points (N, 3) in local NED; `wkt` is "" for a local frame.

    `wkt` is of the plane, `wkt_with_height` of plane and heights, both as OGC WKT 1.
    """

    name: str
    epsg: int | None
    wkt: str
    coordinates: Callable[[Array], Array]
    above_sea: bool = True

    @property
    def wkt_with_height(self) -> str:
        """WKT with the vertical frame, if heights are above mean sea level."""
        if not (self.wkt and self.above_sea):
            return self.wkt
        return f'COMPD_CS["{self.name} + EGM96 height",{self.wkt},{EGM96}]'

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
            return MapFrame("the map's own axes and units", None, "", _same)
        return MapFrame("local east, north, up in metres", None, "", _enu)
    zone = _zone_of(epsg) if epsg else utm_zone(origin.latitude_deg, origin.longitude_deg)
    if zone is None:
        return _by_proj(origin, epsg, above_sea)

    def coordinates(points_ned: Array) -> Array:
        places = geodetic_from_ned(points_ned, origin)
        return np.column_stack([utm_from_geodetic(places[:, 0], places[:, 1], zone), places[:, 2]])

    return MapFrame(zone.name, zone.epsg, _utm_wkt(zone), coordinates, above_sea)


def _enu(points_ned: Array) -> Array:
    return np.asarray(points_ned, np.float64)[:, [1, 0, 2]] * [1, 1, -1]


def _same(points: Array) -> Array:
    return np.asarray(points, np.float64)


def _zone_of(epsg: int) -> UtmZone | None:
    number = epsg % 100
    if epsg - number in (32600, 32700) and 1 <= number <= 60:
        return UtmZone(number, epsg < 32700)
    return None


def _by_proj(origin: GeoOrigin, epsg: int, above_sea: bool) -> MapFrame:
    try:
        from pyproj import CRS, Transformer
        from pyproj.enums import WktVersion
        from pyproj.exceptions import CRSError
    except ImportError as error:
        raise InputError(
            f"EPSG:{epsg} is not UTM on WGS84 and wants PROJ: pip install pyproj"
        ) from error
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

    wkt = crs.to_wkt(WktVersion.WKT1_GDAL)
    return MapFrame(crs.name, epsg, wkt, coordinates, above_sea)


def _utm_wkt(zone: UtmZone) -> str:
    return (
        f'PROJCS["{zone.name}",{WGS84},PROJECTION["Transverse_Mercator"],'
        'PARAMETER["latitude_of_origin",0],'
        f'PARAMETER["central_meridian",{zone.central_meridian_deg:g}],'
        'PARAMETER["scale_factor",0.9996],PARAMETER["false_easting",500000],'
        f'PARAMETER["false_northing",{0 if zone.north else 10000000}],'
        'UNIT["metre",1,AUTHORITY["EPSG","9001"]],AXIS["Easting",EAST],AXIS["Northing",NORTH],'
        f'AUTHORITY["EPSG","{zone.epsg}"]]'
    )
