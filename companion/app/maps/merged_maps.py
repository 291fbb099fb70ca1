"""Site maps of many flights become as few maps as there are sites, merged pair by pair."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np

from companion.errors import InputError
from companion.estimation.site.site_use import world_from_site
from companion.products.report.batch_page import MergedFlight, MergedMap
from companion.products.site_map_file import SITE_MAP, read_site_map, write_site_map
from companion.slam.map.site_flights import SiteFlight, disagreement_m, pixel_m
from companion.slam.map.site_map import SiteMap
from companion.slam.mapping.site_merge import merge_sites

OTHERS = "site-{}.map"
PART_WAY = ".merging"
"""Folder of maps that are part of another by the end."""
Pair = tuple[Path, Path, Path]
"""Two maps, and the file that both as one go to."""
NO_PLACE = "no place is seen in both"
MergePairs = Callable[[Sequence[Pair]], Iterator[str]]
"""Runs `merge_pair` of disjoint pairs, all at once; results in their order."""


def merge_pair(first: Path, other: Path, out: Path) -> str:
    """One Dask task: write two maps as one; "" if done, else why they stay apart."""
    a, b = (read_site_map(path).site for path in (first, other))
    try:
        both = merge_sites(a, b, world_from_site(b.georeference.origin, a.georeference.origin))
    except InputError as error:
        of_a, of_b = (" and ".join(part.flight for part in site.parts) for site in (a, b))
        return f"{of_a}, beside {of_b}: {error}"
    if both is None:
        return NO_PLACE
    write_site_map(out, both)
    return ""


def merge_flights(names: Sequence[str], out: Path, run: MergePairs) -> list[MergedMap]:
    """Merge the site maps of flights, folders of `out`, as far as they see the same places.

    The largest becomes site.map of `out`, others site-2.map and so on; flights without a map, which
    has a scale, are left out. A map that is merged lies in the world of its coarsest flight: pairs
    are joined from the coarsest to the finest, as `merge_sites` wants it.
    """
    for old in [*out.glob(SITE_MAP), *out.glob(OTHERS.format("[0-9]*"))]:
        old.unlink()
    work = out / PART_WAY
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir()
    try:
        islands = [path for name in names if (path := out / name / SITE_MAP).is_file()]
        islands.sort(key=lambda path: -pixel_m(read_site_map(path).site))
        apart: dict[tuple[Path, Path], str] = {}
        n_made = 0
        while pairs := _disjoint(islands, apart):
            wanted = [(*pair, work / f"{n_made + n}.map") for n, pair in enumerate(pairs)]
            n_made += len(wanted)
            for (first, other, made), why_apart in zip(wanted, run(wanted), strict=True):
                if why_apart:
                    apart[first, other] = why_apart
                else:
                    islands[islands.index(first)] = made
                    islands.remove(other)
        found = sorted(islands, key=lambda path: -path.stat().st_size)
        return [
            replace(_kept(path, out, n), refused=_refused(path, apart, islands))
            for n, path in enumerate(found, 1)
        ]
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _refused(
    path: Path, apart: Mapping[tuple[Path, Path], str], islands: Sequence[Path]
) -> tuple[str, ...]:
    """Reasons why a map stays apart from others that are left, but for other places."""
    return tuple(
        why for pair, why in apart.items()
        if path in pair and why != NO_PLACE and set(pair) <= set(islands)
    )  # fmt: skip


def _disjoint(
    islands: Sequence[Path], apart: Container[tuple[Path, Path]]
) -> list[tuple[Path, Path]]:
    """Pairs of maps that were not tried yet, none of them in two."""
    out: list[tuple[Path, Path]] = []
    taken: set[Path] = set()
    for pair in combinations(islands, 2):
        if pair not in apart and taken.isdisjoint(pair):
            out.append(pair)
            taken.update(pair)
    return out


def _kept(path: Path, out: Path, number: int) -> MergedMap:
    site = read_site_map(path).site
    name = SITE_MAP if number == 1 else OTHERS.format(number)
    write_site_map(out / name, site)
    return merged_map(name, site)


def merged_map(name: str, site: SiteMap) -> MergedMap:
    """Share of each flight in a map, and how far it agrees with all others."""
    found = []
    for n, part in enumerate(site.parts):
        own, others = (SiteFlight(site, site.part_of == n), SiteFlight(site, site.part_of != n))
        apart_m, n_shared = disagreement_m(site, own, others)
        n_points = int(np.count_nonzero(own.n_observers))
        path_m = float(np.linalg.norm(np.diff(own.path_m, axis=0), axis=1).sum())
        found.append(
            MergedFlight(part.flight, path_m, len(own.keyframes), n_points, n_shared, apart_m)
        )
    return MergedMap(name, len(site.keyframes), len(site.points.positions), tuple(found))
