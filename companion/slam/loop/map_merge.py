"""Map merging, and loop closure by pose graph."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from companion.geometry.transforms import Array, Pose, Similarity
from companion.slam.features.orb_features import Ints
from companion.slam.loop.loop_closure import LoopClosure, camera_from_there
from companion.slam.map.sparse_map import SlamMap
from companion.slam.optimisation.pose_graph import Edge, relax

MIN_SHARED_POINTS = 30
EDGES_EACH = 6
LOOP_WEIGHT = 5.0
LEAST_BENT = 5e-4
"""Map units, radians, and a ratio less one: at the depth of one unit, with which a map begins, a
quarter of a pixel of a focal length of 500."""
YIELD_EVERY = 10
"""Keyframes whose covisible ones are found in some milliseconds."""


def merge_maps(here: SlamMap, there: SlamMap, here_from_there: Similarity) -> None:
    """Move all of another map into this one; the other is invalid afterwards."""
    offset = here.append_points(there, here_from_there)
    there_from_here = here_from_there.inverse()
    for key, keyframe in there.keyframes.items():
        keyframe.camera_from_map = camera_from_there(keyframe.camera_from_map, there_from_here)
        ids = keyframe.point_ids
        keyframe.point_ids = np.where(ids >= 0, ids + ids.dtype.type(offset), ids)
        keyframe.refined_for = np.full_like(ids, -1)  # by ids of the other map
        here.keyframes[key] = keyframe
        here.unit_of[key] = there.unit_of.get(key, 1.0) * here_from_there.scale
    for key, retired in there.retired.items():
        here.retired[key] = retired.scaled(here_from_there.scale)
        here.unit_of[key] = there.unit_of.get(key, 1.0) * here_from_there.scale
    here.level = here.level and there.level
    here.held |= there.held
    ordered = sorted(here.keyframes.items())
    here.keyframes.clear()
    here.keyframes.update(ordered)
    here.keyframes_moved()


@dataclass(frozen=True, slots=True, eq=False)
class LoopGraph:
    """Pose graph of a map with a loop: the keyframes `keys`, in order, as nodes."""

    keys: list[int]
    nodes: list[Similarity]
    edges: list[Edge]
    newest: int
    oldest: int
    """Rows of the two keyframes of the loop; the second is held."""
    level: bool
    held: tuple[int, ...]
    """Rows of keyframes of an earlier flight; where there are any, these are held instead."""

    def relaxed(self) -> list[Similarity]:
        """Nodes that agree with the loop. Takes long, and needs nothing of the map."""
        return relax(self.nodes, self.edges, self.held or (self.oldest,), self.level)

    def bent(self, relaxed: list[Similarity]) -> set[int]:
        """Keyframes that the loop moves against others, so that adjustment would move them, too."""
        i, j = np.array([(edge.i, edge.j) for edge in self.edges]).T
        bent = np.zeros(len(i), bool)
        for before, after in zip(_between(self.nodes, i, j), _between(relaxed, i, j), strict=True):
            bent |= np.abs(after - before).reshape(len(i), -1).max(1) > LEAST_BENT
        return {self.keys[row] for row in np.union1d(i[bent], j[bent]).tolist()}


def _between(nodes: list[Similarity], i: Ints, j: Ints) -> tuple[Array, Array, Array]:
    """Rotations (E, 3, 3), translations (E, 3) and logarithms of scales (E,) of j in i."""
    rotation = np.stack([node.rotation for node in nodes])
    place = np.stack([node.translation for node in nodes])
    scale = np.array([node.scale for node in nodes])
    back = rotation[i].transpose(0, 2, 1)
    offset = (back @ (place[j] - place[i])[..., None])[..., 0] / scale[i, None]
    return back @ rotation[j], offset, np.log(scale[j] / scale[i])


def loop_graph(
    slam_map: SlamMap, loop: LoopClosure, yield_point: Callable[[], None] = lambda: None
) -> LoopGraph:
    """The graph of a map that a loop closes; `yield_point` is called every few keyframes."""
    keys = list(slam_map.keyframes)
    row = {key: n for n, key in enumerate(keys)}
    nodes = [_node(slam_map.keyframes[key].camera_from_map) for key in keys]
    newest, oldest = loop.keyframe.keyframe_id, loop.relocalised.keyframe.keyframe_id
    corrected = loop.here_from_there.inverse() @ nodes[row[newest]]
    edges = _edges(slam_map, nodes, row, yield_point)
    edges.append(
        Edge(row[newest], row[oldest], corrected.inverse() @ nodes[row[oldest]], LOOP_WEIGHT)
    )
    held = tuple(row[key] for key in keys if key in slam_map.held)
    return LoopGraph(keys, nodes, edges, row[newest], row[oldest], slam_map.level, held)


def close_loop(slam_map: SlamMap, graph: LoopGraph, relaxed: list[Similarity]) -> float:
    """Move the keyframes of a map to the nodes of its relaxed graph, and points with them.

    Returns the displacement of the newest keyframe, map units.
    """
    _move(slam_map, graph.keys, graph.nodes, relaxed)
    before, after = graph.nodes[graph.newest], relaxed[graph.newest]
    return float(np.linalg.norm(after.translation - before.translation))


def _node(camera_from_map: Pose) -> Similarity:
    pose = camera_from_map.inverse()
    return Similarity(1.0, pose.rotation, pose.translation)


def _edges(
    slam_map: SlamMap, nodes: list[Similarity], row: dict[int, int],
    yield_point: Callable[[], None],
) -> list[Edge]:  # fmt: skip
    """Edges of each keyframe to its predecessor and to its most covisible ones."""
    pairs: dict[tuple[int, int], float] = {}
    keys = list(slam_map.keyframes)
    for before, key in pairwise(keys):
        if before not in slam_map.held:  # else the next is of another day, or held as well
            pairs[before, key] = 1.0
    for n, (key, keyframe) in enumerate(slam_map.keyframes.items()):
        if n % YIELD_EVERY == 0:
            yield_point()
        _, ids = slam_map.observations_of(keyframe)
        ranked = [k for _, k in slam_map.covisible(ids, MIN_SHARED_POINTS) if k != key]
        for other in ranked[:EDGES_EACH]:
            pairs[min(key, other), max(key, other)] = 1.0
    return [
        Edge(row[a], row[b], nodes[row[a]].inverse() @ nodes[row[b]], weight)
        for (a, b), weight in sorted(pairs.items())
    ]


def _move(
    slam_map: SlamMap, keys: list[int], before: list[Similarity], after: list[Similarity]
) -> None:
    anchors = _anchors(slam_map, np.array(keys))
    n = slam_map.n_points
    by_anchor = np.argsort(anchors, kind="stable")
    begins = np.searchsorted(anchors[by_anchor], np.arange(len(keys) + 1))
    scales: Array = np.ones(n)
    index = {key: row for row, key in enumerate(keys)}
    for row, (key, old, new) in enumerate(zip(keys, before, after, strict=True)):
        moved = new @ old.inverse()
        keyframe = slam_map.keyframes[key]
        keyframe.camera_from_map = Pose(new.rotation, new.translation).inverse()
        slam_map.unit_of[key] = slam_map.unit_of.get(key, 1.0) * new.scale
        own = by_anchor[begins[row] : begins[row + 1]]
        slam_map.positions[own] = moved.apply(slam_map.positions[own])
        slam_map.normals[own] = slam_map.normals[own] @ moved.rotation.T
        scales[own] = moved.scale
    for key, retired in slam_map.retired.items():
        scale = after[index[retired.anchor_id]].scale
        slam_map.retired[key] = retired.scaled(scale)
        slam_map.unit_of[key] = slam_map.unit_of.get(key, 1.0) * scale
    slam_map.base_distance[:n] *= scales
    slam_map.keyframes_moved()


def _anchors(slam_map: SlamMap, keys: Ints) -> Ints:
    """Index in `keys` of the keyframe that each point moves with: that of its reference view.

    Of a culled one, its anchor.
    """
    seen, which = np.unique(slam_map.first_seen[: slam_map.n_points], return_inverse=True)
    retired = slam_map.retired
    anchor_ids = [retired[k].anchor_id if k in retired else k for k in seen.tolist()]
    first = np.array(anchor_ids, np.int64)[which]
    return np.asarray(np.clip(np.searchsorted(keys, first), 0, len(keys) - 1), np.int64)
