"""Keyframe culling: hovering adds nothing, references to culled keyframes stay valid."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from companion.geometry.transforms import Array, Pose, Similarity, angle_between, yaw_rotation
from companion.slam.features.orb_features import Ints
from companion.slam.features.patches import image_levels
from companion.slam.loop.loop_closure import LoopDetector
from companion.slam.loop.map_merge import close_loop, loop_graph, merge_maps
from companion.slam.loop.place_recognition import KeyframeDatabase
from companion.slam.loop.relocalizer import Relocalizer
from companion.slam.map.sparse_map import Keyframe, SlamMap
from companion.slam.mapping.culling import N_NEWEST_KEPT, N_OLDEST_KEPT, cull_keyframes, retire
from tests.support.reference.synthetic_map import CAMERA, GREY, Ground, flown, mapped

NOWHERE = Similarity.identity()
SPACING_DEG = 2.0


def culled(path: list[Pose]) -> tuple[SlamMap, list[int]]:
    """The map of a path with culling at each keyframe, and the ids culled."""
    gone: list[int] = []

    def cull(slam_map: SlamMap, newest: Keyframe) -> None:
        gone.extend(cull_keyframes(slam_map, newest, SPACING_DEG))

    ground = Ground(np.random.default_rng(4), n=3000)
    return mapped(ground, path, NOWHERE, after_each=cull), gone


def hovering(n: int) -> list[Pose]:
    rng = np.random.default_rng(5)
    return [flown(rng.normal(scale=0.08, size=2)) for _ in range(n)]


def test_hovering_leaves_a_handful_of_keyframes() -> None:
    slam_map, gone = culled(hovering(40))
    assert len(slam_map.keyframes) <= N_OLDEST_KEPT + N_NEWEST_KEPT + 4
    assert len(slam_map.keyframes) + len(gone) == 40
    assert sorted(gone) == sorted(slam_map.retired)
    anchors = {r.anchor_id for r in slam_map.retired.values()}
    assert anchors <= set(slam_map.keyframes)
    seen = [slam_map.observations_of(k)[1] for k in slam_map.keyframes.values()]
    count = np.bincount(np.concatenate(seen), minlength=slam_map.n_points)
    assert (count[slam_map.alive[: slam_map.n_points]] >= 2).all()


def test_return_passes_add_nothing_and_straight_flight_loses_nothing() -> None:
    there = [flown(p) for p in np.linspace((-7, 0), (7, 0), 20)]
    once, gone = culled(there)
    assert gone == []
    again, _ = culled((there + there[::-1]) * 2)
    assert len(again.keyframes) <= len(once.keyframes) + N_NEWEST_KEPT + 2


def test_unique_views_are_kept() -> None:
    turning = [flown(np.zeros(2), yaw_rad=a) for a in np.linspace(0, np.pi, 20)]
    away = [flown(p) for p in np.linspace((0, 0), (9, 0), 4)]
    _, gone = culled([*away, *turning])
    assert not set(gone) & set(range(N_OLDEST_KEPT, len(away)))


def test_references_to_a_culled_keyframe_follow_its_anchor() -> None:
    path = [flown(p) for p in np.linspace((-4, 0), (4, 0), 9)]
    slam_map = mapped(Ground(np.random.default_rng(6)), path, NOWHERE)
    for key, stays in ((4, 5), (5, 6)):
        retire(slam_map, slam_map.keyframes[key], slam_map.keyframes[stays])
    assert slam_map.retired[4].anchor_id == 6
    shift = Pose(yaw_rotation(0.3), np.array([2.0, -1.0, 0.5]))
    keyframe = slam_map.keyframes[6]
    keyframe.camera_from_map = keyframe.camera_from_map @ shift.inverse()
    for key in (4, 5):
        pose = slam_map.pose_of(key)
        assert pose is not None
        wanted = shift @ path[key]
        assert pose.inverse().translation == pytest.approx(wanted.translation, abs=1e-9)
        assert angle_between(pose.inverse().rotation, wanted.rotation) < 1e-9
    assert slam_map.pose_of(99) is None
    places = dict(slam_map.poses())
    assert sorted(places) == list(range(9))
    for key, place in places.items():
        pose = slam_map.pose_of(key)
        assert pose is not None
        assert place.matrix() == pytest.approx(pose.inverse().matrix(), abs=1e-9)


def test_loop_closure_and_merge_move_culled_keyframes() -> None:
    ground = Ground(np.random.default_rng(7))
    corners = [(0.0, 0.0), (16.0, 0.0), (16.0, 16.0), (0.0, 16.0), (0.0, 1.0)]
    path = [flown(p) for a, b in itertools.pairwise(corners) for p in np.linspace(a, b, 9)]
    slam_map = mapped(ground, path, NOWHERE, memory=12)
    retire(slam_map, slam_map.keyframes[30], slam_map.keyframes[31])
    for key, keyframe in slam_map.keyframes.items():
        pose = keyframe.camera_from_map.inverse()
        shift = np.array([0.0, 0.05 * key, 0.0])
        keyframe.camera_from_map = Pose(pose.rotation, pose.translation + shift).inverse()
    slam_map.positions[: slam_map.n_points, 1] += 0.05 * slam_map.first_seen[: slam_map.n_points]
    index = KeyframeDatabase()
    for key, keyframe in slam_map.keyframes.items():
        index.add(key, keyframe.features.descriptors)
    newest = slam_map.keyframes[max(slam_map.keyframes)]
    finder = LoopDetector(index, Relocalizer(CAMERA))
    found = finder.find(newest, slam_map, [slam_map], lambda loop, same: True)
    assert found is not None
    graph = loop_graph(slam_map, found)
    close_loop(slam_map, graph, graph.relaxed())
    own = np.flatnonzero(slam_map.first_seen[: slam_map.n_points] == 30)

    def off(moved: SlamMap, scale: float) -> float:
        """Of the culled keyframe from its neighbour, in the unit of the first map."""
        pose = moved.pose_of(30)
        assert pose is not None
        apart = pose.inverse().translation - moved.keyframes[31].centre
        return float(np.linalg.norm(apart)) / scale

    there = path[30].translation - path[31].translation
    unit = slam_map.unit_of[31]
    assert off(slam_map, 1.0) == pytest.approx(unit * np.linalg.norm(there), rel=0.03)
    assert slam_map.unit_of[30] == pytest.approx(unit)
    assert np.median(np.abs(slam_map.positions[own] - ground_of(slam_map, own, ground))) < 0.3
    other = mapped(ground, path[:6], Similarity(0.5, np.eye(3), np.zeros(3)), first_id=100)
    merge_maps(other, slam_map, Similarity(0.5, np.eye(3), np.zeros(3)))
    assert off(other, 0.5 * unit) == pytest.approx(np.linalg.norm(there), rel=0.03)
    assert other.unit_of[30] == pytest.approx(0.5 * unit)


def ground_of(slam_map: SlamMap, ids: Ints, ground: Ground) -> Array:
    """The true points nearest to mapped ones."""
    apart = np.linalg.norm(ground.points[None] - slam_map.positions[ids][:, None], axis=2)
    out: Array = ground.points[apart.argmin(1)]
    return out


def test_database_removes_and_reuses_rows() -> None:
    ground = Ground(np.random.default_rng(8))
    seen = [ground.seen_from(flown(p))[0].descriptors for p in np.linspace((-9, 0), (9, 0), 40)]
    index = KeyframeDatabase()
    for key, descriptors in enumerate(seen):
        index.add(key, descriptors)
    assert index.query(seen[20], 1) == [20]
    for key in range(10, 30):
        index.remove(key)
    assert len(index) == 20
    assert not set(index.query(seen[20], 5)) & set(range(10, 30))
    for key in range(10, 30):
        index.add(100 + key, seen[key])
    assert len(index) == 40
    assert index.query(seen[20], 1) == [120]
    assert sum(b.n_keys for b in index._blocks) == 40
    assert len(index._blocks) == 2


def test_ids_of_removed_points_are_recycled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.slam.map.sparse_map.MIN_POINTS_RECYCLED", 6000)
    monkeypatch.setattr("companion.slam.map.sparse_map.ID_QUARANTINE_KEYFRAMES", 4)
    ground = Ground(np.random.default_rng(9))
    slam_map = mapped(ground, [flown(np.zeros(2)), flown(np.array([1.0, 0]))], NOWHERE)
    keyframe, levels = slam_map.keyframes[0], image_levels(GREY)
    kept = slam_map.observations_of(keyframe)[1].copy()
    before = slam_map.positions[kept].copy()
    features = np.arange(len(keyframe.features))
    most = 0
    last = np.zeros(0, np.int64)
    for _ in range(100):
        ids = slam_map.add_points(
            np.ones((len(features), 3)), 0, keyframe.features, features, levels
        )
        assert not np.intersect1d(ids, kept).size
        assert not np.intersect1d(ids, last).size
        assert slam_map.alive[ids].all()
        assert len(np.unique(ids)) == len(ids)
        slam_map.alive[ids] = False
        slam_map.free_patches()
        slam_map.recycle_ids()
        last = ids
        most = max(most, slam_map.n_points)
    assert 100 * len(features) > 2 * most
    assert most < 6000 + 10 * len(features)
    assert np.array_equal(slam_map.positions[kept], before)
    assert slam_map.alive[kept].all()
