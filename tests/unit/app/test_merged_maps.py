"""Maps of many flights: as few as there are sites, whatever order they come in."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from companion.app.maps.map_command import merge
from companion.app.maps.merged_maps import Pair, merge_flights, merge_pair
from companion.errors import InputError
from companion.geometry.transforms import Array, Pose, Similarity
from companion.products.report.batch_page import batch_page
from companion.products.site_map_file import SITE_MAP, read_site_map, write_site_map
from companion.slam.map.site_map import SiteGeoreference, SitePart, site_map_of
from tests.support.reference.synthetic_map import CAMERA, Ground, flown, mapped


def fly(
    out: Path, name: str, ground: Ground, begin: Array, end: Array, sigma_m: float = 1.0,
    patches: bool = True, lower_m: float = 0.0,
) -> None:  # fmt: skip
    path = [flown(place) for place in np.linspace(begin, end, 9)]
    path = [Pose(each.rotation, each.translation + [0.0, 0.0, lower_m]) for each in path]
    made = mapped(ground, path, Similarity.identity())
    placed = SiteGeoreference(None, sigma_m, 0.02, 0.01, "gps")
    part = SitePart(name, 0, CAMERA, 1)
    (out / name).mkdir()
    site = site_map_of(made, Similarity.identity(), (part,), {}, placed, 1)
    if not patches:
        level = np.full_like(site.points.patch_level, -1)
        site = replace(site, points=site.points._replace(patch_level=level))
    write_site_map(out / name / SITE_MAP, site)


def one_by_one(pairs: Sequence[Pair]) -> Iterator[str]:
    files = [path for pair in pairs for path in pair[:2]]
    assert len(set(files)) == len(files)  # they may be merged at the same time
    return (merge_pair(*pair) for pair in pairs)


def test_flights_that_only_a_third_one_joins_and_one_over_another_site(tmp_path: Path) -> None:
    ground = Ground(np.random.default_rng(5))
    west, middle, east = (np.array([north, 0.0]) for north in (-20, 0, 20))
    fly(tmp_path, "west", ground, west, west + [8, 0])
    fly(tmp_path, "east", ground, east - [8, 0], east)
    fly(tmp_path, "elsewhere", Ground(np.random.default_rng(6)), middle, middle + [8, 0])
    fly(tmp_path, "across", ground, west + [5, 0.5], east - [5, 0.5])
    (tmp_path / "lost").mkdir()
    (tmp_path / "site-7.map").write_bytes(b"of a run before")
    names = ["west", "east", "elsewhere", "across", "lost"]
    maps = merge_flights(names, tmp_path, one_by_one)
    flights = [sorted(each.flight for each in found.flights) for found in maps]
    assert flights == [["across", "east", "west"], ["elsewhere"]]
    assert [found.name for found in maps] == [SITE_MAP, "site-2.map"]
    assert {p.name for p in tmp_path.iterdir() if p.is_file()} == {SITE_MAP, "site-2.map"}
    assert not (tmp_path / ".merging").exists()
    assert len(read_site_map(tmp_path / SITE_MAP).site.keyframes) == 27
    for each in maps[0].flights:
        assert each.n_shared > 50 and each.apart_m is not None and 0 < each.apart_m < 0.1
    page = batch_page([], {}, maps).decode()
    assert "site-2.map" in page and "No place in it is seen in the other maps" in page


def test_maps_that_meet_and_are_not_joined_are_named_with_the_reason(tmp_path: Path) -> None:
    ground = Ground(np.random.default_rng(5))
    west = np.array([-20.0, 0.0])
    fly(tmp_path, "one", ground, west, west + [8, 0], sigma_m=1e-4, patches=False)
    fly(
        tmp_path, "two", ground, west + [3, 1], west + [11, 1], sigma_m=1e-4, patches=False,
        lower_m=0.5,
    )  # fmt: skip
    fly(tmp_path, "elsewhere", Ground(np.random.default_rng(6)), west, west + [8, 0])
    maps = merge_flights(["one", "two", "elsewhere"], tmp_path, one_by_one)
    told = {each.flights[0].flight: each.refused for each in maps}
    assert told["elsewhere"] == ()
    for name in ("one", "two"):
        (why,) = told[name]
        assert why.startswith("one, beside two: the maps meet at one place only")
    page = batch_page([], {}, maps).decode()
    assert page.count("Stays apart: one, beside two") == 2
    assert page.count("No place in it is seen in the other maps") == 1


def test_the_finest_map_is_joined_last_in_whatever_order_they_are_named(tmp_path: Path) -> None:
    ground = Ground(np.random.default_rng(5))
    west = np.array([-20.0, 0.0])
    fly(tmp_path, "high", ground, west, west + [8, 0])
    fly(tmp_path, "low", ground, west + [3, 1], west + [11, 1], lower_m=2.0)
    high, low = tmp_path / "high", tmp_path / "low"
    made = []
    for n, order in enumerate(((high, low), (low, high))):
        out = tmp_path / f"{n}.map"
        assert merge(order, out).startswith(f"{low}: bound by ")
        made.append(read_site_map(out).site)
    assert [part.flight for part in made[0].parts] == ["high", "low"]
    for a, b in zip(made[0].keyframes, made[1].keyframes, strict=True):
        np.testing.assert_array_equal(a.centre, b.centre)
    merge_flights(["low", "high"], tmp_path, one_by_one)
    both = read_site_map(tmp_path / SITE_MAP).site
    assert [part.flight for part in both.parts] == ["high", "low"]


def test_maps_that_only_a_third_one_joins_are_merged_in_any_order(tmp_path: Path) -> None:
    ground = Ground(np.random.default_rng(5))
    west, east = (np.array([north, 0.0]) for north in (-20, 20))
    fly(tmp_path, "west", ground, west, west + [8, 0])
    fly(tmp_path, "east", ground, east - [8, 0], east)
    fly(tmp_path, "across", ground, west + [5, 0.5], east - [5, 0.5])
    fly(tmp_path, "elsewhere", Ground(np.random.default_rng(6)), west, west + [8, 0])
    out = tmp_path / "site.map"
    merge([tmp_path / name for name in ("west", "east", "across")], out)
    assert len(read_site_map(out).site.keyframes) == 27
    with pytest.raises(InputError) as refused:
        merge([tmp_path / name for name in ("west", "elsewhere")], tmp_path / "none.map")
    assert "no place in it is seen in" in str(refused.value)
    assert not (tmp_path / "none.map").exists()
