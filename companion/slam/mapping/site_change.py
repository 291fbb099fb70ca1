"""Changes between two maps of a site, told by free space: gone, new and moved things.

Both maps are merged, so that one adjustment places both. A point of one flight that the other
never observes has gone only if the other looked through the place where it was; what the other did
not see says nothing. A change is a group of such points.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from companion.geometry.transforms import Array, Similarity
from companion.messages import Bytes
from companion.slam.features.matching import mutual_matches
from companion.slam.features.orb_features import Bools, Ints
from companion.slam.map.free_space import MAX_EDGE_RAD, SIGMAS, looked_through
from companion.slam.map.site_flights import SiteFlight, disagreement_m
from companion.slam.map.site_map import SiteMap
from companion.slam.mapping.site_merge import merge_sites

MIN_POINTS = 6
"""Points of a thing: fewer come of mismatches."""
MIN_OBSERVERS = 3
"""Keyframes that observe a point which is believed."""
MAX_BITS, RATIO = 50, 0.8
"""Of descriptors of the same corner, as in the search for points of the map."""
MIN_MOVED, MIN_MOVED_SHARE = 4, 0.15
"""Corners of a thing that has moved by one shift, and their share of the smaller side. From another
side and at another time a quarter of the corners of a thing are known again; of two things none is.
"""

Kind = Literal["gone", "new", "moved"]


@dataclass(frozen=True, slots=True, eq=False)
class SiteChange:
    """One thing: its points (N, 3), world of the first map, metres, as the flight that saw it had.

    It is told by `n_views` keyframes, the median over its points, that look through them, each by
    more than `threshold_m`. `moved_m` (3,) is the shift of a thing that moved, whose points are of
    the place where it was.
    """

    kind: Kind
    points_m: Array
    n_views: int
    threshold_m: float
    moved_m: Array | None = None

    @property
    def centre_m(self) -> Array:
        """Median of its points (3,)."""
        return np.asarray(np.median(self.points_m, axis=0))

    @property
    def size_m(self) -> Array:
        """Extent (3,) along north, east and down."""
        return np.asarray(np.ptp(self.points_m, axis=0))


@dataclass(frozen=True, slots=True, eq=False)
class SiteComparison:
    """Changes from one map to another; all in the world of the first.

    `apart_m` is the standard deviation, of one axis, by which the maps disagree on the `n_shared`
    points that both observe; None where they are too few, and no change is told then. `n_looked`
    are points of each map at places that the other flight saw; of all others nothing is known.
    """

    changes: tuple[SiteChange, ...]
    apart_m: float | None
    n_shared: int
    n_points: tuple[int, int]
    n_looked: tuple[int, int]
    path_before_m: Array
    path_after_m: Array


def compare_sites(
    before: SiteMap, after: SiteMap, after_in_before: Similarity
) -> SiteComparison | None:
    """Compare two maps of a site; None where no place of one is seen in the other."""
    both = merge_sites(before, after, after_in_before)
    return None if both is None else changes_in(both, len(before.parts))


def changes_in(both: SiteMap, n_before: int) -> SiteComparison:
    """Changes from the first `n_before` parts of a merged map to the others."""
    is_before: Bools = both.part_of < n_before
    flights = SiteFlight(both, is_before), SiteFlight(both, ~is_before)
    off_m, n_shared = disagreement_m(both, *flights)
    before, after = flights
    n_points = _n_believed(before), _n_believed(after)
    if off_m is None:
        return SiteComparison((), None, n_shared, n_points, (0, 0), before.path_m, after.path_m)
    things, n_looked = [], []
    for own, other in (flights, flights[::-1]):
        candidates = np.flatnonzero(
            (own.n_observers >= MIN_OBSERVERS)
            & (other.n_observers == 0)
            & np.isfinite(both.covariances[:, 0, 0])
        )
        seen = looked_through(
            other.keyframes, both.points.positions, both.covariances, candidates, off_m
        )
        n_looked.append(int(np.count_nonzero(seen.n_through + seen.n_confirming)) + n_shared)
        things.append(_things(both, own, candidates[seen.gone], seen.n_through[seen.gone]))
    return SiteComparison(
        _with_moved(both, things[0], things[1], off_m), off_m, n_shared, n_points,
        (n_looked[0], n_looked[1]), before.path_m, after.path_m,
    )  # fmt: skip


def _n_believed(flight: SiteFlight) -> int:
    return int(np.count_nonzero(flight.n_observers >= MIN_OBSERVERS))


@dataclass(frozen=True, slots=True, eq=False)
class _Thing:
    ids: Ints
    n_views: int


def _things(both: SiteMap, own: SiteFlight, ids: Ints, n_views: Ints) -> list[_Thing]:
    """Groups of neighbouring points."""
    if len(ids) < MIN_POINTS:
        return []
    at = both.points.positions[ids]
    away = cKDTree(own.path_m).query(at)[0]
    reach = MAX_EDGE_RAD * away  # nothing is known of narrower gaps
    pairs = cKDTree(at).query_pairs(float(reach.max()), output_type="ndarray")
    near = np.linalg.norm(at[pairs[:, 0]] - at[pairs[:, 1]], axis=1) <= reach[pairs].min(1)
    pairs = pairs[near]
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(ids),) * 2)
    _, group = connected_components(graph, directed=False)
    out = []
    for n in np.flatnonzero(np.bincount(group) >= MIN_POINTS):
        own_ids: Bools = group == n
        out.append(_Thing(ids[own_ids], int(np.median(n_views[own_ids]))))
    return out


def _with_moved(
    both: SiteMap, gone: list[_Thing], new: list[_Thing], off_m: float
) -> tuple[SiteChange, ...]:
    """Gone and new things, the largest first; those of the same look are one that moved."""
    left = list(new)
    out = []
    for thing in gone:
        match: tuple[_Thing, Array] | None = None
        for other in left:
            shift = _shift(both, thing, other, off_m)
            if shift is not None:
                match = other, shift
                break
        if match is None:
            out.append(_change(both, "gone", thing, off_m))
        else:
            left = [each for each in left if each is not match[0]]
            out.append(_change(both, "moved", thing, off_m, match[1]))
    out += [_change(both, "new", thing, off_m) for thing in left]
    return tuple(sorted(out, key=lambda change: -len(change.points_m)))


def _shift(both: SiteMap, a: _Thing, b: _Thing, off_m: float) -> Array | None:
    """The shift (3,) that takes the corners of one thing to those of the other; None without."""
    descriptors: Bytes = both.points.descriptors
    ia, ib = mutual_matches(descriptors[a.ids], descriptors[b.ids], MAX_BITS, RATIO)
    if len(ia) < MIN_MOVED:
        return None
    shifts = both.points.positions[b.ids[ib]] - both.points.positions[a.ids[ia]]
    near = SIGMAS * max(_sigma_m(both, a, off_m), _sigma_m(both, b, off_m))
    agree = np.linalg.norm(shifts[:, None] - shifts[None], axis=2) <= near
    best: Bools = agree[agree.sum(1).argmax()]
    if best.sum() < max(MIN_MOVED, MIN_MOVED_SHARE * min(len(a.ids), len(b.ids))):
        return None
    return np.asarray(shifts[best].mean(0))


def _sigma_m(both: SiteMap, thing: _Thing, off_m: float) -> float:
    """Standard deviation of its points along their least known axis, the median over them."""
    largest = np.linalg.eigvalsh(both.covariances[thing.ids])[:, -1]
    return float(np.sqrt(np.median(largest) + off_m**2))


def _change(
    both: SiteMap, kind: Kind, thing: _Thing, off_m: float, moved_m: Array | None = None
) -> SiteChange:
    threshold_m = SIGMAS * _sigma_m(both, thing, off_m)
    at = both.points.positions[thing.ids]
    return SiteChange(kind, at, thing.n_views, threshold_m, moved_m)
