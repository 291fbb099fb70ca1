"""Thinned paths: few corners, near the path, in bounded memory."""

from __future__ import annotations

import numpy as np
import pytest

from companion.geometry.thinned_path import KEPT, OPEN, STEP_M, ThinnedPath, thinned
from companion.geometry.transforms import Array


def away_m(places: Array, path: Array) -> float:
    """Largest distance of a path from the polyline through places."""
    a, along = places[:-1, None], np.diff(places, axis=0)[:, None]
    share = ((path[None] - a) * along).sum(2) / (along**2).sum(2)
    on = a + np.clip(share, 0, 1)[..., None] * along
    return float(np.linalg.norm(path[None] - on, axis=2).min(0).max())


def helix(n: int, turns: float) -> Array:
    angle = np.linspace(0, 2 * np.pi * turns, n)
    return np.stack([20 * np.cos(angle), 20 * np.sin(angle), -0.5 * angle], 1)


def test_a_thinned_path_stays_near_the_path() -> None:
    path = helix(2000, 1.5)
    for within_m in (0.1, 1.0):
        places = thinned(path, within_m)
        assert away_m(places, path) <= within_m
        assert 5 < len(places) < 20 / np.sqrt(within_m) + 60
        assert (places[0] == path[0]).all() and (places[-1] == path[-1]).all()
    assert len(thinned(np.zeros((50, 3)), 0.5)) == 2


@pytest.mark.parametrize("n", [2, 5, OPEN, OPEN + 1, 3 * OPEN + 7])
def test_a_path_is_thinned_as_it_is_flown(n: int) -> None:
    path, flown = helix(n, n / 1000), ThinnedPath()
    for place in path:
        flown.add(place)
    places = flown.places()
    assert away_m(places, path) <= flown.within_m + STEP_M
    assert flown.within_m == 0.5
    assert (places[0] == path[0]).all()
    assert np.linalg.norm(places[-1] - path[-1]) < STEP_M
    assert len(places) < 10 + n / 20


def test_a_path_without_end_gets_coarser_and_says_so() -> None:
    rng, flown = np.random.default_rng(5), ThinnedPath()
    path = np.cumsum(rng.normal(0, 1.0, (12_000, 3)), axis=0)
    for place in path:
        flown.add(place)
    places = flown.places()
    assert len(places) <= KEPT + OPEN
    assert 0.5 < flown.within_m < 200
    assert max(away_m(places, part) for part in np.array_split(path, 40)) <= flown.within_m + STEP_M


def test_no_place_and_one_are_no_path() -> None:
    flown = ThinnedPath()
    assert flown.places().shape == (0, 3)
    for _ in range(1000):
        flown.add(np.zeros(3))
    assert flown.places().shape == (0, 3)
