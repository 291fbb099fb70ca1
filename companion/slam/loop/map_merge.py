"""What a reunion does to maps: two become one, or a loop in one closes."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from companion.geometry.transforms import Array, Pose, Similarity
from companion.slam.features.orb_features import Ints
from companion.slam.loop.loop_closure import Reunion, camera_from_there
from companion.slam.map.sparse_map import SlamMap
from companion.slam.optimisation.pose_graph import Edge, relax

MIN_SHARED_POINTS = 30
EDGES_EACH = 6
LOOP_WEIGHT = 5.0


def weld(here: SlamMap, there: SlamMap, here_from_there: Similarity) -> None:
    """Take all of another map into this one; the other is not to be used any more."""
    offset = here.take_points(there, here_from_there)
    there_from_here = here_from_there.inverse()
    for key, keyframe in there.keyframes.items():
        keyframe.camera_from_map = camera_from_there(keyframe.camera_from_map, there_from_here)
        keyframe.point_ids = np.where(keyframe.point_ids >= 0, keyframe.point_ids + offset, -1)
        keyframe.refined_for[:] = -1  # by ids of the other map
        here.keyframes[key] = keyframe
        here.unit_of[key] = there.unit_of.get(key, 1.0) * here_from_there.scale
    for key, retired in there.retired.items():
        here.retired[key] = retired.scaled(here_from_there.scale)
        here.unit_of[key] = there.unit_of.get(key, 1.0) * here_from_there.scale
    here.level = here.level and there.level
    ordered = sorted(here.keyframes.items())
    here.keyframes.clear()
    here.keyframes.update(ordered)
    here.poses_changed()


def close_loop(slam_map: SlamMap, reunion: Reunion) -> float:
    """Move keyframes, and their points with them, so that the loop closes.

    Returns how far the newest end of it moved, in map units.
    """
    keys = list(slam_map.keyframes)
    place = {key: n for n, key in enumerate(keys)}
    nodes = [_node(slam_map.keyframes[key].camera_from_map) for key in keys]
    newest, oldest = reunion.keyframe.keyframe_id, reunion.located.keyframe.keyframe_id
    should_be = reunion.here_from_there.inverse() @ nodes[place[newest]]
    edges = _edges(slam_map, nodes, place)
    edges.append(
        Edge(place[newest], place[oldest], should_be.inverse() @ nodes[place[oldest]], LOOP_WEIGHT)
    )
    relaxed = relax(nodes, edges, place[oldest], slam_map.level)
    _move(slam_map, keys, nodes, relaxed)
    before, after = nodes[place[newest]], relaxed[place[newest]]
    return float(np.linalg.norm(after.translation - before.translation))


def _node(camera_from_map: Pose) -> Similarity:
    pose = camera_from_map.inverse()
    return Similarity(1.0, pose.rotation, pose.translation)


def _edges(slam_map: SlamMap, nodes: list[Similarity], place: dict[int, int]) -> list[Edge]:
    """Each keyframe with the one before it and with those that it shares most points with."""
    pairs: dict[tuple[int, int], float] = {}
    keys = list(slam_map.keyframes)
    for before, key in pairwise(keys):
        pairs[before, key] = 1.0
    for key, keyframe in slam_map.keyframes.items():
        _, ids = slam_map.seen_by(keyframe)
        ranked = [k for n, k in slam_map.covisible(ids, MIN_SHARED_POINTS) if k != key]
        for other in ranked[:EDGES_EACH]:
            pairs[min(key, other), max(key, other)] = 1.0
    return [
        Edge(place[a], place[b], nodes[place[a]].inverse() @ nodes[place[b]], weight)
        for (a, b), weight in sorted(pairs.items())
    ]


def _move(
    slam_map: SlamMap, keys: list[int], before: list[Similarity], after: list[Similarity]
) -> None:
    homes = _homes(slam_map, np.array(keys))
    n = slam_map.n_points
    scales: Array = np.ones(n)
    index = {key: place for place, key in enumerate(keys)}
    for place, (key, old, new) in enumerate(zip(keys, before, after, strict=True)):
        moved = new @ old.inverse()
        keyframe = slam_map.keyframes[key]
        keyframe.camera_from_map = Pose(new.rotation, new.translation).inverse()
        slam_map.unit_of[key] = slam_map.unit_of.get(key, 1.0) * new.scale
        own = np.flatnonzero(homes == place)
        slam_map.positions[own] = moved.apply(slam_map.positions[own])
        slam_map.normals[own] = slam_map.normals[own] @ moved.rotation.T
        scales[own] = moved.scale
    for key, retired in slam_map.retired.items():
        scale = after[index[retired.beside_id]].scale
        slam_map.retired[key] = retired.scaled(scale)
        slam_map.unit_of[key] = slam_map.unit_of.get(key, 1.0) * scale
    slam_map.base_distance[:n] *= scales
    slam_map.poses_changed()


def _homes(slam_map: SlamMap, keys: Ints) -> Ints:
    """Place in `keys` of the keyframe that each point moves with: the one it was first seen by.

    Or, where that went, the one beside it.
    """
    seen, which = np.unique(slam_map.first_seen[: slam_map.n_points], return_inverse=True)
    retired = slam_map.retired
    stays = [retired[k].beside_id if k in retired else k for k in seen.tolist()]
    first = np.array(stays, np.int64)[which]
    return np.asarray(np.clip(np.searchsorted(keys, first), 0, len(keys) - 1), np.int64)
