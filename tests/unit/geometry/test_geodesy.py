from __future__ import annotations

import numpy as np
import pytest

from companion.geometry.geodesy import GeoOrigin, geodetic_from_ned, ned_from_geodetic, origin_of

HOME = GeoOrigin(-35.363262, 149.165237, 584.09)


def test_degree_of_latitude_and_longitude() -> None:
    """Meridian 110.574 km a degree and parallel 111.320 km a degree at the equator (WGS84)."""
    equator = GeoOrigin(0.0, 10.0, 0.0)
    assert ned_from_geodetic(0.01, 10.0, 0.0, equator)[0] == pytest.approx(1105.74, abs=0.01)
    assert ned_from_geodetic(0.0, 10.01, 0.0, equator)[1] == pytest.approx(1113.195, abs=0.01)


def test_up_is_negative() -> None:
    np.testing.assert_allclose(
        ned_from_geodetic(HOME.latitude_deg, HOME.longitude_deg, 600.0, HOME),
        [0, 0, 584.09 - 600],
        atol=1e-8,
    )


def test_origin_of() -> None:
    latitude, longitude, altitude = -35.36, 149.17, 612.0
    position = ned_from_geodetic(latitude, longitude, altitude, HOME)
    found = origin_of(latitude, longitude, altitude, position)
    away = ned_from_geodetic(found.latitude_deg, found.longitude_deg, found.altitude_m, HOME)
    assert np.abs(away).max() < 0.1


def test_round_trip() -> None:
    """A position kilometres away returns to micrometres."""
    places = np.array([[-35.3, 149.1, 700.0], [-35.4, 149.3, -20.0]])
    ned = np.stack([ned_from_geodetic(lat, lon, alt, HOME) for lat, lon, alt in places])
    back = geodetic_from_ned(ned, HOME)
    np.testing.assert_allclose(back[:, :2], places[:, :2], atol=1e-11)
    np.testing.assert_allclose(back[:, 2], places[:, 2], atol=1e-6)
