"""Scale from a climb over one spot, by rangefinder."""

from __future__ import annotations

import numpy as np
import pytest

from companion.estimation.georeference.range_climb import climb_scale
from companion.geometry.transforms import Array

SCALE = 2.5


def flown(top_m: float, drift: float, slope: float = 0.0) -> tuple[Array, Array]:
    """Places in a map and ranges of a climb to a height that drifts by a part of it, on a slope."""
    height_m = np.linspace(0.3, top_m, 40)
    north_m = drift * height_m
    places_m = np.stack([north_m, 0.0 * height_m, -height_m], 1)
    rng = np.random.default_rng(1)
    ranges_m = height_m + slope * north_m + rng.normal(scale=0.03, size=40)
    return places_m / SCALE + [3.0, 2.0, 1.0], ranges_m


@pytest.mark.parametrize(
    ("top_m", "drift", "slope"), [(5.0, 0.1, 0.0), (5.0, 0.2, 0.08), (2.0, 0.0, 0.0)]
)
def test_a_climb_tells_the_scale(top_m: float, drift: float, slope: float) -> None:
    found = climb_scale(*flown(top_m, drift, slope))
    assert found is not None
    assert abs(found.scale / SCALE - 1) < 2 * found.sigma
    assert found.sigma < 0.05


@pytest.mark.parametrize(("top_m", "drift"), [(0.9, 0.0), (5.0, 1.0)])
def test_no_climb_or_one_along_a_slant_tells_nothing(top_m: float, drift: float) -> None:
    assert climb_scale(*flown(top_m, drift)) is None


def test_views_that_disagree_make_it_uncertain() -> None:
    """Half of the way up it drifts over a roof."""
    places, ranges_m = flown(6.0, 0.1)
    ranges_m[20:] -= 2.0
    found = climb_scale(places, ranges_m)
    assert found is None or found.sigma > 0.2
