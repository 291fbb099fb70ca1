"""A map most of which lies in a file does all that one in memory does, to the bit."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.config import FeaturesConfig
from companion.geometry.transforms import Similarity, yaw_rotation
from companion.products.array_file import ArrayFile
from companion.products.site_map_file import read_site_map, write_site_map
from companion.slam.features.orb_features import Ints
from companion.slam.features.patches import image_levels
from companion.slam.loop.loop_closure import LoopDetector
from companion.slam.loop.map_merge import close_loop, loop_graph, merge_maps
from companion.slam.loop.place_recognition import KeyframeDatabase
from companion.slam.loop.relocalizer import Relocalizer
from companion.slam.map.map_part import part_of
from companion.slam.map.patch_store import NO_PATCH
from companion.slam.map.site_map import SiteGeoreference, SitePart, site_map_of, slam_map_of
from companion.slam.map.sparse_map import Keyframe, SlamMap
from companion.slam.mapping import far_keyframes
from companion.slam.mapping.atlas import Atlas
from companion.slam.mapping.far_keyframes import leave_behind
from companion.slam.mapping.map_adjustment import partition
from companion.slam.mapping.mapper import Mapper
from companion.slam.mapping.mapping_worker import MapLock
from tests.support.reference.synthetic_map import CAMERA, GREY, Ground, bend, flown, mapped

CORNERS = [(0.0, 0.0), (16.0, 0.0), (16.0, 16.0), (0.0, 16.0), (0.0, 1.0)]
N_NEAR = 6
TO_WORLD = Similarity(2.5, yaw_rotation(0.4), np.array([10.0, -20.0, -30.0]))


class Full:
    """A file on a full disk."""

    def put(self, arrays: Sequence[Any]) -> None:
        return None


@pytest.fixture(autouse=True)
def few_near(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(far_keyframes, "N_NEAR", N_NEAR)


def flown_round(file: Any, seed: int = 6) -> SlamMap:
    """A square back to its beginning, keyframes put away as they are left behind."""
    random = np.random.default_rng(seed)
    path = [flown(p) for a, b in itertools.pairwise(CORNERS) for p in np.linspace(a, b, 9)]
    grey = random.integers(0, 256, GREY.shape, dtype=np.uint8)

    def left(slam_map: SlamMap, keyframe: Keyframe) -> None:
        ids = np.flatnonzero(slam_map.born[: slam_map.n_points] == keyframe.keyframe_id)
        slam_map.patches.near[slam_map.patch_at[ids]] = image_levels(grey)[0][:24, :24]
        slam_map.patches.near[slam_map.patch_at[ids], 0, 0] = ids % 256
        leave_behind(slam_map, file, MapLock())

    return mapped(
        Ground(np.random.default_rng(seed)), path, Similarity.identity(), memory=12, after_each=left
    )


def everything(slam_map: SlamMap) -> list[Any]:
    """All of a map that results are made of."""
    part = part_of(slam_map, slam_map.keyframes)
    out: list[Any] = [*part.points]
    for k in part.keyframes:
        out += [k.camera_from_map.matrix(), k.point_ids, k.refined_for, k.normalised, k.whitening]
        out += [getattr(k.features, name) for name in far_keyframes.OF_FEATURES]
    return out


def assert_same(one: SlamMap, other: SlamMap) -> None:
    for a, b in zip(everything(one), everything(other), strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_newest_stay_in_memory_and_nothing_is_changed(tmp_path: Path) -> None:
    file = ArrayFile(tmp_path)
    whole, away = flown_round(None), flown_round(file)
    in_file = [not k.normalised.flags.writeable for k in away.keyframes.values()]
    assert in_file == [True] * (len(in_file) - N_NEAR) + [False] * N_NEAR
    assert file.n_bytes > 1_000_000
    assert (away.patch_at[: away.n_points] < -1).any()
    file.forget()
    assert_same(whole, away)


def test_rows_of_patches_that_were_put_away_are_used_again(tmp_path: Path) -> None:
    away = flown_round(ArrayFile(tmp_path))
    n_alive = np.count_nonzero(away.alive)
    assert np.count_nonzero(away.patch_at[: away.n_points] >= 0) < 0.6 * n_alive


def test_a_loop_with_keyframes_in_the_file_closes_as_without(tmp_path: Path) -> None:
    file = ArrayFile(tmp_path)
    maps = [flown_round(None), flown_round(file)]
    for slam_map in maps:
        bend(slam_map, 0.05)
        file.forget()
        index = KeyframeDatabase()
        for key, keyframe in slam_map.keyframes.items():
            index.add(key, keyframe.features.descriptors)
        newest = slam_map.keyframes[max(slam_map.keyframes)]
        before = newest.centre
        finder = LoopDetector(index, Relocalizer(CAMERA))
        found = finder.find(newest, slam_map, [slam_map], lambda found, same: True)
        assert found is not None
        other = found.relocalised.keyframe
        assert other.keyframe_id < 4 and other.is_far
        graph = loop_graph(slam_map, found)
        close_loop(slam_map, graph, graph.relaxed())
        mapper = Mapper(CAMERA, slam_map, MapLock())
        mapper.close_loop(newest, other, slam_map.observations_of(other)[1])
        mapper.adjust_all(3)
        assert np.linalg.norm(newest.centre - before) > 0.3
    assert_same(*maps)


def test_maps_in_the_file_are_merged_as_without(tmp_path: Path) -> None:
    file = ArrayFile(tmp_path)
    there_to_here = Similarity(0.5, np.eye(3), np.array([1.0, 2.0, 3.0]))
    merged = []
    for kept in (None, file):
        here, there = flown_round(kept), flown_round(kept, seed=7)
        there.keyframes = {key + 100: k for key, k in there.keyframes.items()}
        for key, k in there.keyframes.items():
            k.keyframe_id = key
        merge_maps(here, there, there_to_here)
        merged.append(here)
    assert_same(*merged)


def test_a_map_read_into_the_file_is_that_in_memory(tmp_path: Path) -> None:
    """A flight over the same ground is located in it, bound to it and adjusted, as without."""
    part = SitePart("morning", 0, CAMERA, 1)
    georeference = SiteGeoreference(None, 1.0, 0.02, 0.01, "gps")
    site = site_map_of(flown_round(None), TO_WORLD, (part,), {}, georeference, 1)
    path = tmp_path / "site.map"
    write_site_map(path, site)
    file = ArrayFile(tmp_path)
    maps = []
    for far in (None, file):
        there = slam_map_of(read_site_map(path, far).site, CAMERA)
        in_file = [not k.features.descriptors.flags.writeable for k in there.keyframes.values()]
        assert in_file == [far is not None] * len(in_file)
        here = mapped(
            Ground(np.random.default_rng(6)), [flown(np.array([x, 0.5])) for x in range(6)],
            Similarity.identity(), first_id=1000,
        )  # fmt: skip
        index = KeyframeDatabase()
        for key, keyframe in there.keyframes.items():
            index.add(key, keyframe.features.descriptors)
        newest = here.keyframes[1005]
        finder = LoopDetector(index, Relocalizer(CAMERA))
        file.forget()
        found = finder.find(newest, here, [there], lambda found, same: True)
        assert found is not None
        merge_maps(here, there, found.here_from_there)
        mapper = Mapper(CAMERA, here, MapLock())
        for key in range(1000, 1006):
            mapper.fusion.fuse_held(here.keyframes[key])
        mapper.adjust_locally(newest)
        shared = np.isin(newest.point_ids, np.concatenate([k.point_ids for k in held(here)]))
        assert shared.sum() > 100
        maps.append(here)
    assert file.n_bytes > 500_000 and (maps[1].patch_at < NO_PATCH).sum() > 500
    assert_same(*maps)


def test_each_window_of_a_large_adjustment_may_be_forgotten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("companion.slam.mapping.map_adjustment.MAX_VARIABLE", 8)
    file, n_forgotten = ArrayFile(tmp_path), []
    atlas = Atlas(FeaturesConfig(), CAMERA, MapLock())
    atlas.far_file = file
    monkeypatch.setattr(file, "forget", lambda: n_forgotten.append(1))
    slam_map = flown_round(file)
    n_windows = len(list(partition(slam_map)))
    n_forgotten.clear()
    mapper = atlas.mapper_of(slam_map)
    mapper.adjust_all(1)
    assert len(n_forgotten) == n_windows > 3
    mapper.adjust_all_in_background(1, lambda: None, lambda: True)
    assert len(n_forgotten) == 2 * n_windows


def held(slam_map: SlamMap) -> list[Keyframe]:
    return [slam_map.keyframes[key] for key in sorted(slam_map.held)]


def test_a_full_disk_leaves_all_in_memory(tmp_path: Path) -> None:
    assert_same(flown_round(None), flown_round(Full()))


@pytest.fixture
def recycling(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.slam.map.sparse_map.MIN_POINTS_RECYCLED", 0)
    monkeypatch.setattr("companion.slam.map.sparse_map.ID_QUARANTINE_KEYFRAMES", 1)


def unnamed(slam_map: SlamMap, keyframe: Keyframe) -> Ints:
    """Points that a keyframe names, but none that is left behind."""
    return np.setdiff1d(keyframe.point_ids, np.flatnonzero(slam_map.is_named))


@pytest.mark.usefixtures("recycling")
def test_ids_that_far_keyframes_name_are_not_used_again(tmp_path: Path) -> None:
    away = flown_round(ArrayFile(tmp_path))
    far, near = away.keyframes[0], away.keyframes[max(away.keyframes)]
    named = np.setdiff1d(far.point_ids, near.point_ids)
    alone, later = np.array_split(unnamed(away, near), [-5])
    away.add_observations(far, np.arange(4), later[:4])
    away.move_observation(far, 4, int(later[4]))
    assert len(named) and len(alone) and len(later) == 5
    away.alive[np.concatenate([named, later, alone])] = False
    for _ in range(3):
        away.recycle_ids()
    assert set(alone.tolist()) <= set(away._free_ids)
    assert set(away._free_ids).isdisjoint([*named.tolist(), *later.tolist()])
    assert (far.point_ids == named[-1]).any() and not np.isin(near.point_ids, alone).any()


@pytest.mark.usefixtures("recycling")
def test_dead_points_of_a_keyframe_that_is_left_behind_are_used_again(tmp_path: Path) -> None:
    away = flown_round(ArrayFile(tmp_path))
    near = away.keyframes[max(away.keyframes)]
    dead, alive = np.array_split(unnamed(away, near), 2)
    near.refined_for[:] = near.point_ids
    away.alive[dead] = False
    away.leave_behind(near)
    for _ in range(3):
        away.recycle_ids()
    assert set(dead.tolist()) <= set(away._free_ids)
    assert away.is_named[alive].all()
    np.testing.assert_array_equal(near.refined_for, near.point_ids)
    assert not np.isin(near.point_ids, dead).any() and np.isin(alive, near.point_ids).all()
