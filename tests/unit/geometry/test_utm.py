"""UTM against PROJ, an independent implementation."""

from __future__ import annotations

import numpy as np
import pytest
from pyproj import CRS, Transformer

from companion.errors import InputError
from companion.geometry.utm import UtmZone, utm_from_geodetic, utm_zone


@pytest.mark.parametrize("zone", [UtmZone(33, True), UtmZone(55, False), UtmZone(1, True)])
def test_same_as_proj_within_a_micrometre(zone: UtmZone, rng: np.random.Generator) -> None:
    latitude = rng.uniform(0, 84, 300) if zone.north else rng.uniform(-80, 0, 300)
    longitude = zone.central_meridian_deg + rng.uniform(-4, 4, 300)
    ours = utm_from_geodetic(latitude, longitude, zone)
    proj = Transformer.from_crs(4326, zone.epsg, always_xy=True)
    theirs = np.stack(proj.transform(longitude, latitude), 1)
    assert np.abs(ours - theirs).max() < 1e-6
    assert CRS.from_epsg(zone.epsg).name == zone.name


@pytest.mark.parametrize(
    ("latitude", "longitude", "epsg"),
    [(-35.36, 149.17, 32755), (47.4, 8.55, 32632), (60.39, 5.32, 32632), (78.2, 15.6, 32633),
     (0.0, -180.0, 32601), (10.0, 180.0, 32601), (-0.1, 179.9, 32760)],
)  # fmt: skip
def test_zones(latitude: float, longitude: float, epsg: int) -> None:
    """Canberra, Zurich, Bergen and Spitsbergen; the last two have zones by exception."""
    assert utm_zone(latitude, longitude).epsg == epsg


def test_no_zone_at_the_poles() -> None:
    with pytest.raises(InputError, match="EPSG"):
        utm_zone(85.0, 10.0)
