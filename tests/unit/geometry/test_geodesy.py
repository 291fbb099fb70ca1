from __future__ import annotations

import numpy as np
from pyproj import Transformer

from companion.geometry.geodesy import GeoOrigin, geodetic_from_ned, ned_from_geodetic, origin_of

HOME = GeoOrigin(-35.363262, 149.165237, 584.09)


def test_there_and_back_as_proj_has_it(rng: np.random.Generator) -> None:
    """Tens of kilometres away, within two micrometres."""
    for _ in range(100):
        latitude, longitude, altitude = rng.uniform([-89, -180, -100], [89, 180, 5000]).tolist()
        origin = GeoOrigin(latitude, longitude, altitude)
        enu_from_geodetic = Transformer.from_pipeline(
            "+proj=pipeline +ellps=WGS84 +step +proj=unitconvert +xy_in=deg +xy_out=rad "
            f"+step +proj=cart +step +proj=topocentric +lat_0={latitude!r} +lon_0={longitude!r} "
            f"+h_0={altitude!r}"
        )
        ned = rng.uniform(-30_000, 30_000, 3) * [1, 1, 0.1]
        here = geodetic_from_ned(ned[None], origin)[0]
        east, north, up = enu_from_geodetic.transform(here[1], here[0], here[2])
        np.testing.assert_allclose([north, east, -up], ned, atol=2e-6)
        back = ned_from_geodetic(here[0], here[1], here[2], origin)
        np.testing.assert_allclose(back, ned, atol=2e-6)


def test_origin_of() -> None:
    latitude, longitude, altitude = -35.36, 149.17, 612.0
    position = ned_from_geodetic(latitude, longitude, altitude, HOME)
    found = origin_of(latitude, longitude, altitude, position)
    away = ned_from_geodetic(found.latitude_deg, found.longitude_deg, found.altitude_m, HOME)
    assert np.abs(away).max() < 0.1
