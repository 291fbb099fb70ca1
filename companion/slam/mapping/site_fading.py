"""Fading of what has gone from a site: points that later flights look through are left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from companion.slam.features.orb_features import Bools
from companion.slam.map.free_space import Looked, looked_through
from companion.slam.map.map_points import PointArrays
from companion.slam.map.site_flights import SiteFlight, disagreement_m
from companion.slam.map.site_map import SiteMap


def faded(site: SiteMap) -> SiteMap:
    """The map without points that keyframes of later flights look through, again and again.

    Witnesses of a point are the keyframes of all flights after the last that observes it, so that
    evidence adds up over flights. A point that none of them could see stays.
    """
    n_parts = len(site.parts)
    n_points = len(site.points.positions)
    flights = [SiteFlight(site, site.part_of == part) for part in range(n_parts)]
    last = np.full(n_points, -1)
    for part, flight in enumerate(flights):
        last[flight.n_observers > 0] = part
    seen = Looked(np.zeros(n_points, np.int64), np.zeros(n_points, np.int64))
    for part in range(1, n_parts):
        later = flights[part]
        candidates = np.flatnonzero((last < part) & np.isfinite(site.covariances[:, 0, 0]))
        if not later.keyframes or not len(candidates):
            continue
        off_m, _ = disagreement_m(site, SiteFlight(site, site.part_of < part), later)
        if off_m is None:  # how well the flight lies in the map is not known
            continue
        told = looked_through(
            later.keyframes, site.points.positions, site.covariances, candidates, off_m
        )
        seen.n_through[candidates] += told.n_through
        seen.n_confirming[candidates] += told.n_confirming
    return _without(site, seen.gone) if seen.gone.any() else site


def _without(site: SiteMap, gone: Bools) -> SiteMap:
    """The map without some of its points."""
    left = np.flatnonzero(~gone)
    index = np.full(len(gone) + 1, -1)  # its last is that of no point
    index[left] = np.arange(len(left))
    keyframes = tuple(
        replace(k, point_ids=index[k.point_ids], refined_for=index[k.refined_for])
        for k in site.keyframes
    )
    points = PointArrays._make(values[left] for values in site.points)
    return replace(site, keyframes=keyframes, points=points, covariances=site.covariances[left])
