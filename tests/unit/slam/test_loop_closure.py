"""Place recognition, upright pose solver, map merging, loop closure and false loops."""

from __future__ import annotations

import itertools
import threading
from typing import Any

import numpy as np
import pytest

from companion.config import FeaturesConfig
from companion.geometry.transforms import (
    Array,
    Pose,
    Similarity,
    angle_between,
    rotation_from_vector,
    yaw_rotation,
)
from companion.messages import Georeference
from companion.slam.loop import map_merge
from companion.slam.loop.loop_closure import LoopClosure, LoopDetector
from companion.slam.loop.map_merge import close_loop, loop_graph, merge_maps
from companion.slam.loop.place_recognition import KeyframeDatabase
from companion.slam.loop.relocalizer import Relocalizer
from companion.slam.map.sparse_map import SlamMap
from companion.slam.mapping.atlas import Atlas
from companion.slam.mapping.map_adjustment import partition
from companion.slam.mapping.mapping_worker import MapLock
from companion.slam.optimisation.pose_graph import Edge, relax
from companion.slam.optimisation.upright_pose import upright_pose
from tests.support.reference.synthetic_map import CAMERA, Ground, bend, flown, mapped

NOWHERE = Similarity.identity()
ELSEWHERE = Similarity(0.4, yaw_rotation(1.1), np.array([3.0, -7.0, 2.0]))


def line(start: tuple[float, float], end: tuple[float, float], n: int, yaw: float) -> list[Pose]:
    return [flown(p, yaw) for p in np.linspace(start, end, n)]


def index_of(*maps: SlamMap) -> KeyframeDatabase:
    index = KeyframeDatabase()
    for slam_map in maps:
        for key, keyframe in slam_map.keyframes.items():
            index.add(key, keyframe.features.descriptors)
    return index


def find(newest: int, here: SlamMap, maps: list[SlamMap]) -> LoopClosure | None:
    finder = LoopDetector(index_of(*maps), Relocalizer(CAMERA))
    return finder.find(here.keyframes[newest], here, maps, lambda found, same: True)


def test_query_returns_the_place_and_nothing_else() -> None:
    ground = Ground(np.random.default_rng(1))
    path = line((-20, -20), (20, -20), 40, 0.0)
    index = KeyframeDatabase()
    for key, pose in enumerate(path):
        index.add(key, ground.seen_from(pose)[0].descriptors)
    again, _ = ground.seen_from(flown(np.array([0.3, -19.8]), yaw_rad=2.0))
    assert set(index.query(again.descriptors, 3)) <= {18, 19, 20, 21, 22}
    assert 21 not in index.query(again.descriptors, 3, {21})


@pytest.mark.parametrize("wrong_share", [0.0, 0.7])
def test_two_points_and_gravity_give_a_pose(wrong_share: float) -> None:
    rng = np.random.default_rng(3)
    tilted = yaw_rotation(1.2) @ rotation_from_vector(np.array([0.3, -0.2, 0.0]))
    camera = Pose(tilted @ flown(np.zeros(2)).rotation, np.array([3.0, 4.0, -20.0])).inverse()
    points: Array = np.c_[rng.uniform(-8, 12, (200, 2)), rng.uniform(-3, 0, 200)]
    p = camera.apply(points)
    seen = p[:, :2] / p[:, 2:]
    wrong = rng.random(200) < wrong_share
    seen[wrong] += rng.normal(size=(int(wrong.sum()), 2))
    other_heading = yaw_rotation(0.7) @ camera.rotation.T
    found = upright_pose(points, seen, other_heading, 0.005, seed=1)
    assert found is not None
    pose, agree = found
    assert angle_between(pose.rotation, camera.rotation) < 1e-6
    assert np.abs(pose.translation - camera.translation).max() < 1e-6
    assert (agree | wrong).all()


def test_one_point_is_not_enough() -> None:
    assert upright_pose(np.ones((1, 3)), np.zeros((1, 2)), np.eye(3), 0.01, seed=1) is None


def test_pose_graph_removes_the_drift_of_a_closed_square() -> None:
    corners = [(0, 0), (10, 0), (10, 10), (0, 10), (0, 0)]
    truth = [
        Similarity(1.0, yaw_rotation(k * np.pi / 2), np.array([*p, -5.0]))
        for k in range(4)
        for p in np.linspace(corners[k], corners[k + 1], 10, endpoint=False)
    ]
    steps = [a.inverse() @ b for a, b in itertools.pairwise(truth)]
    drift = Similarity(1.004, yaw_rotation(0.004), np.array([0.02, -0.01, 0.015]))
    drifted = [truth[0]]
    for step in steps:
        drifted.append(drifted[-1] @ step @ drift)
    edges = [
        Edge(k, k + 1, a.inverse() @ b) for k, (a, b) in enumerate(itertools.pairwise(drifted))
    ]
    before = max(
        float(np.linalg.norm(a.translation - b.translation))
        for a, b in zip(drifted, truth, strict=True)
    )
    edges.append(Edge(len(truth) - 1, 0, truth[-1].inverse() @ truth[0], 100.0))
    relaxed = relax(drifted, edges, fixed=(0,), level=True)
    errors = [
        float(np.linalg.norm(a.translation - b.translation))
        for a, b in zip(relaxed, truth, strict=True)
    ]
    assert before > 1.5
    assert max(errors) < 0.25 * before
    assert errors[-1] < 0.05
    tilts = [abs(n.rotation[2, 2] - 1.0) for n in relaxed]
    assert max(tilts) < 1e-9


def test_overlapping_maps_are_merged() -> None:
    ground = Ground(np.random.default_rng(5))
    old = mapped(ground, line((-6, 0), (6, 0), 9, 0.0), ELSEWHERE)
    new = mapped(ground, line((6, 12), (2, 0.5), 9, 0.6), NOWHERE, first_id=20)
    found = find(28, new, [old, new])
    assert found is not None
    assert found.there is old
    assert found.here_from_there.scale == pytest.approx(1 / ELSEWHERE.scale, rel=0.01)
    n_points = new.n_points
    merge_maps(new, old, found.here_from_there)
    assert list(new.keyframes) == [*range(9), *range(20, 29)]
    assert new.unit_of == pytest.approx(dict.fromkeys(range(9), 1 / ELSEWHERE.scale), rel=0.01)
    for key, x in ((0, -6.0), (8, 6.0)):
        assert new.keyframes[key].centre == pytest.approx([x, 0, -10], abs=0.15)
    features, points = new.observations_of(new.keyframes[4])
    assert (points >= n_points).all()
    p = new.keyframes[4].camera_from_map.apply(new.positions[points])
    error = CAMERA.project(p) - new.keyframes[4].features.pixels[features]
    assert np.median(np.linalg.norm(error, axis=1)) < 1.5


def test_loop_closure_moves_its_points() -> None:
    ground = Ground(np.random.default_rng(6))
    corners = [(0.0, 0.0), (16.0, 0.0), (16.0, 16.0), (0.0, 16.0), (0.0, 1.0)]
    sides = itertools.pairwise(corners)
    path = [pose for a, b in sides for pose in line(a, b, 9, 0.0)]
    slam_map = mapped(ground, path, NOWHERE, memory=12)
    bend(slam_map, 0.05)
    newest = max(slam_map.keyframes)
    off = np.linalg.norm(slam_map.keyframes[newest].centre - path[-1].translation)
    assert off > 1.0
    found = find(newest, slam_map, [slam_map])
    assert found is not None
    assert found.relocalised.keyframe.keyframe_id < 4
    graph = loop_graph(slam_map, found)
    moved = close_loop(slam_map, graph, graph.relaxed())
    assert moved == pytest.approx(off, rel=0.2)
    assert slam_map.keyframes[newest].centre == pytest.approx(path[-1].translation, abs=0.3)
    keyframe = slam_map.keyframes[newest]
    features, points = slam_map.observations_of(keyframe)
    own = slam_map.first_seen[points] == newest
    p = keyframe.camera_from_map.apply(slam_map.positions[points[own]])
    error = CAMERA.project(p) - keyframe.features.pixels[features[own]]
    assert np.median(np.linalg.norm(error, axis=1)) < 1.5


def test_windows_that_a_loop_does_not_bend_are_not_adjusted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Out and back to the middle: what was flown before the middle turns as a whole."""
    monkeypatch.setattr("companion.slam.mapping.map_adjustment.MAX_VARIABLE", 6)
    ground = Ground(np.random.default_rng(6))
    corners = [(-24.0, 20.0), (-24.0, 0.0), (0.0, 0.0), (16.0, 0.0), (16.0, 16.0), (0.0, 16.0)]
    sides = itertools.pairwise([*corners, (0.0, 1.0)])
    path = [pose for a, b in sides for pose in line(a, b, 9, 0.0)]
    slam_map = mapped(ground, path, NOWHERE, memory=12)
    bend(slam_map, 0.05)
    newest = max(slam_map.keyframes)
    found = find(newest, slam_map, [slam_map])
    assert found is not None
    middle = found.relocalised.keyframe.keyframe_id
    assert 12 < middle < 22
    graph = loop_graph(slam_map, found)
    bent = graph.bent(graph.relaxed())
    assert newest in bent and min(bent) >= middle - 3 and len(bent) > 20
    windows = [{k.keyframe_id for k in part} for part, _, _ in partition(slam_map)]
    adjusted = [{k.keyframe_id for k in part} for part, _, _ in partition(slam_map, bent)]
    assert adjusted == [window for window in windows if window & bent]
    assert 0 < len(windows) - len(adjusted) <= middle


def test_frames_are_tracked_while_the_graph_of_a_loop_is_relaxed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ground = Ground(np.random.default_rng(6))
    corners = [(0.0, 0.0), (16.0, 0.0), (16.0, 16.0), (0.0, 16.0), (0.0, 1.0)]
    path = [pose for a, b in itertools.pairwise(corners) for pose in line(a, b, 9, 0.0)]
    slam_map = mapped(ground, path, NOWHERE, memory=12)
    bend(slam_map, 0.05)
    found = find(max(slam_map.keyframes), slam_map, [slam_map])
    assert found is not None
    lock = MapLock()
    atlas = Atlas(FeaturesConfig(), CAMERA, lock, background=True)
    atlas.segments = [slam_map]
    begins_anew, n_tracked = False, 0

    def frame() -> None:
        nonlocal n_tracked
        with lock.tracking():
            n_tracked += 1
            if begins_anew:
                atlas.new_map(level=False)

    def relaxed(*graph: Any) -> list[Similarity]:
        thread = threading.Thread(target=frame)
        thread.start()
        thread.join(60)
        return relax(*graph)

    monkeypatch.setattr(map_merge, "relax", relaxed)
    point = lock.point
    with lock.mapping():
        assert atlas._close(slam_map, atlas.mapper, found) is not None
    assert n_tracked == 1
    assert lock.point - point > len(slam_map.keyframes) / 10  # and it yields besides
    assert found.keyframe.centre == pytest.approx(path[-1].translation, abs=0.3)
    begins_anew = True
    bend(slam_map, 0.05)
    drifted = found.keyframe.centre
    with lock.mapping():
        assert atlas._close(slam_map, atlas.mapper, found) is None
    assert found.keyframe.centre == pytest.approx(drifted)


@pytest.mark.parametrize("level", [True, False], ids=["level", "vision alone"])
def test_repetitive_facade_is_no_loop(level: bool) -> None:
    ground = Ground(np.random.default_rng(7))
    ground.repeat(period=4.0)
    slam_map = mapped(ground, line((-24, 0), (24, 0), 30, 0.0), NOWHERE)
    slam_map.level = level
    assert find(29, slam_map, [slam_map]) is None


@pytest.mark.parametrize("level", [True, False], ids=["level", "vision alone"])
def test_passes_that_no_place_word_joined_are_joined_in_the_end(level: bool) -> None:
    """There and back beside itself, nothing indexed; with attitude all is as it was."""
    ground = Ground(np.random.default_rng(6))
    corners = [(0.0, 0.0), (24.0, 0.0), (24.0, 2.0), (0.0, 2.0)]
    path = [pose for a, b in itertools.pairwise(corners) for pose in line(a, b, 14, 0.0)]
    slam_map = mapped(ground, path, NOWHERE, memory=6)
    slam_map.level = level
    bend(slam_map, 0.01)
    off = [float(np.linalg.norm(slam_map.keyframes[41].centre - path[-1].translation))]
    atlas = Atlas(FeaturesConfig(), CAMERA, MapLock())
    atlas.segments = [slam_map]
    closed = atlas.close_near_loops()
    off.append(float(np.linalg.norm(slam_map.keyframes[41].centre - path[-1].translation)))
    if level:
        assert not closed and off[1] == off[0]
    else:
        assert closed and all(loop.same_map for loop in closed)
        assert off[1] < 0.3 * off[0]


def test_a_repetitive_facade_beside_itself_is_no_loop() -> None:
    """Two passes along it, so far apart that windows and not corners are the same."""
    ground = Ground(np.random.default_rng(7))
    ground.repeat(period=4.0)
    slam_map = mapped(ground, line((-24, 0), (24, 0), 60, 0.0), NOWHERE)
    atlas = Atlas(FeaturesConfig(), CAMERA, MapLock())
    atlas.segments = [slam_map]
    assert atlas.close_near_loops() == []


def test_places_of_its_own_map_keep_none_of_another_out() -> None:
    """A camera that comes to one place again and again, seen from aside in the other map."""
    ground = Ground(np.random.default_rng(8))
    here, away = line((0, 0), (1.4, 0), 8, 0.0), line((0, 5), (0, 26), 30, 0.0)
    path = [*here, *away, *away[::-1], *here[:6]]
    new = mapped(ground, path, NOWHERE, first_id=20, memory=6)
    old = mapped(ground, line((1.5, -2), (1.5, 2), 7, 0.4), ELSEWHERE)
    finder = LoopDetector(index_of(old, new), Relocalizer(CAMERA))
    newest = new.keyframes[max(new.keyframes)]
    found = finder.find(newest, new, [old, new], lambda found, same: not same)
    assert found is not None
    assert found.there is old


def test_maps_that_met_only_while_neither_knew_are_joined_in_the_end() -> None:
    """The older one was gone on with last, to where the newer one is."""
    ground = Ground(np.random.default_rng(9))
    old = mapped(ground, line((-14, 0), (3, 0), 18, 0.0), ELSEWHERE)
    new = mapped(ground, line((12, 6), (2, 0.5), 12, 0.5), NOWHERE, first_id=40)
    apart = mapped(ground, line((-20, 20), (-14, 24), 7, 0.0), NOWHERE, first_id=60)
    atlas = Atlas(FeaturesConfig(), CAMERA, MapLock())
    atlas.segments = [new, apart, old]
    for segment in atlas.segments:
        for keyframe in segment.keyframes.values():
            atlas.index_keyframe(keyframe)
    (joined,) = atlas.join_maps()
    assert not joined.same_map
    assert [len(segment.keyframes) for segment in atlas.segments] == [30, 7]
    whole = atlas.segments[0]
    known = np.array([keyframe.centre for keyframe in whole.keyframes.values()])
    true = [*line((-14, 0), (3, 0), 18, 0.0), *line((12, 6), (2, 0.5), 12, 0.5)]
    assert known == pytest.approx(np.array([pose.translation for pose in true]), abs=0.2)


def test_a_faint_place_is_found_again_where_satellites_say_it_is() -> None:
    """Six of seven corners are others than before, as noise has it."""
    rng = np.random.default_rng(10)
    ground = Ground(rng, n=16_000)
    old = mapped(ground, line((-14, 0), (3, 0), 18, 0.0), ELSEWHERE)
    others = rng.random(len(ground.points)) < 6 / 7
    ground.descriptors[others] = rng.integers(0, 256, (int(others.sum()), 32))
    new = mapped(ground, line((3, 0.5), (-8, 0.5), 12, 0.5), NOWHERE, first_id=40)
    assert find(45, new, [old]) is None
    atlas = atlas_of(new, old, off_m=(0.6, -0.8, 0.2))
    finder = LoopDetector(KeyframeDatabase(), Relocalizer(CAMERA))
    found = finder.find_placed(
        new.keyframes[45], new, [old], atlas.georeference_of, lambda found, same: not same
    )
    assert found is not None
    assert found.here_from_there.apply(old.keyframes[3].centre) == pytest.approx(
        line((-14, 0), (3, 0), 18, 0.0)[3].translation, abs=0.2
    )
    (joined,) = atlas.join_maps()
    assert not joined.same_map


def test_another_piece_of_a_repetitive_facade_is_not_found() -> None:
    """Satellites place it where windows and not corners are the same."""
    ground = Ground(np.random.default_rng(7))
    ground.repeat(period=4.0)
    old = mapped(ground, line((-20, 0), (-12, 0), 12, 0.0), ELSEWHERE)
    new = mapped(ground, line((-3, 0.5), (6, 0.5), 12, 0.0), NOWHERE, first_id=40)
    assert atlas_of(new, old, off_m=(4.0, 0.0, 0.0)).join_maps() == []


def atlas_of(new: SlamMap, old: SlamMap, off_m: tuple[float, float, float]) -> Atlas:
    """A flight of two maps, of which satellites place the older one wrong by that."""
    atlas = Atlas(FeaturesConfig(), CAMERA, MapLock())
    atlas.segments = [old, new]
    for segment in atlas.segments:
        for keyframe in segment.keyframes.values():
            atlas.index_keyframe(keyframe)
    world_from = {id(new): NOWHERE, id(old): Similarity(1.0, np.eye(3), np.array(off_m))}
    world_from[id(old)] @= ELSEWHERE.inverse()
    atlas.georeference_of = lambda segment: Georeference(
        world_from[id(segment)], 0.01, 0.01, "made up", 10, 0.1
    )
    return atlas
