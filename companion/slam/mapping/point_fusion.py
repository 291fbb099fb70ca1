"""Fusion of points: what one keyframe sees of the points of others, and points that are one."""

from __future__ import annotations

import numpy as np

from companion.geometry.camera import Camera
from companion.slam.compiled.searching import find_both
from companion.slam.features.orb_features import Ints
from companion.slam.map.local_map import Projector
from companion.slam.map.sparse_map import Keyframe, SlamMap
from companion.slam.mapping.mapping_worker import MapLock

N_NEIGHBOURS = 8
N_HELD_NEAR = 60
"""Keyframes of an earlier flight whose points are looked for: 2 ms to gather."""


class PointFusion:
    """Fusion of points between keyframes of one map."""

    def __init__(self, camera: Camera, slam_map: SlamMap, map_lock: MapLock) -> None:
        self._projector = Projector(camera)
        self._map, self._map_lock = slam_map, map_lock

    def extend(self, keyframe: Keyframe, neighbours: list[Keyframe], created: Ints) -> None:
        """Project points of this keyframe into its neighbours and vice versa; fuse duplicates."""
        slam_map = self._map
        for other in neighbours:
            self._map_lock.yield_to_tracking()
            _, mine = slam_map.observations_of(keyframe)
            self._fuse_into(other, mine)
        theirs = (
            np.unique(np.concatenate([slam_map.observations_of(o)[1] for o in neighbours]))
            if neighbours
            else created
        )
        self._fuse_into(keyframe, theirs)
        _, mine = slam_map.observations_of(keyframe)
        slam_map.update_geometry(mine, [*reversed(neighbours), keyframe])

    def _fuse_into(self, keyframe: Keyframe, points: Ints) -> None:
        slam_map = self._map
        known = np.zeros(slam_map.n_points, bool)
        known[slam_map.observations_of(keyframe)[1]] = True
        points = points[~known[points] & slam_map.alive[points]]
        visible = self._projector.visible(slam_map, keyframe.camera_from_map, points)
        ids, features = self._projector.search(
            slam_map, visible, keyframe.features, 3.0, max_distance=50
        )
        if len(ids) == 0:
            return
        old = keyframe.point_ids[features]
        old = np.where((old >= 0) & slam_map.alive[np.maximum(old, 0)], old, -1)
        free = old < 0
        slam_map.add_observations(keyframe, features[free], ids[free])
        for point, duplicate in zip(ids[~free].tolist(), old[~free].tolist(), strict=True):
            self._merge(point, duplicate)

    def _merge(self, a: int, b: int) -> None:
        """Merge two points: the one with more observations takes over those of the other."""
        slam_map = self._map
        if a == b or not (slam_map.alive[a] and slam_map.alive[b]):
            return
        keep, drop = (a, b) if slam_map.n_observers[a] >= slam_map.n_observers[b] else (b, a)
        known = slam_map.observers[drop]
        for key in sorted(set(known[known >= 0].tolist())):
            keyframe = slam_map.keyframes.get(key)
            if keyframe is None:
                continue
            feature, n_drop, has_keep = find_both(keyframe.point_ids, drop, keep)
            if n_drop and has_keep:
                keyframe.point_ids[keyframe.point_ids == drop] = -1
            elif n_drop == 1:
                slam_map.move_observation(keyframe, feature, keep)
            elif n_drop:
                features = np.flatnonzero(keyframe.point_ids == drop)
                slam_map.add_observations(keyframe, features, np.full(n_drop, keep))
        slam_map.alive[drop] = False
        slam_map.n_observers[drop] = 0
        slam_map.n_visible[keep] += slam_map.n_visible[drop]
        slam_map.n_found[keep] += slam_map.n_found[drop]

    def fuse_held(self, keyframe: Keyframe) -> None:
        """Let a keyframe observe the points of an earlier flight that are to be seen from it."""
        near = self.held_near(keyframe)
        if near:
            seen = [self._map.observations_of(k)[1] for k in near]
            self._map_lock.yield_to_tracking()
            self._fuse_into(keyframe, np.unique(np.concatenate(seen)))

    def held_near(self, keyframe: Keyframe) -> list[Keyframe]:
        """Keyframes of an earlier flight, the nearest ones."""
        slam_map = self._map
        if not slam_map.held:
            return []
        others = slam_map.keyframes.keys() - slam_map.held
        near = slam_map.nearest(keyframe.centre, N_HELD_NEAR, others)
        return [slam_map.keyframes[k] for k in near]

    def fuse_sides(self, keyframe: Keyframe, other: Keyframe, seen_there: Ints) -> None:
        """Fuse points of the two sides of a closed loop."""
        slam_map = self._map
        _, ids = slam_map.observations_of(keyframe)
        here = [slam_map.keyframes[k] for _, k in slam_map.covisible(ids, 10)][:N_NEIGHBOURS]
        _, ids = slam_map.observations_of(other)
        there = [slam_map.keyframes[k] for _, k in slam_map.covisible(ids, 10)][:N_NEIGHBOURS]
        seen_here = np.unique(
            np.concatenate([slam_map.observations_of(k)[1] for k in [keyframe, *here]])
        )
        for k, seen in [
            *((k, seen_there) for k in [keyframe, *here]),
            *((k, seen_here) for k in [other, *there]),
        ]:
            self._map_lock.yield_to_tracking()
            self._fuse_into(k, seen)
        slam_map.clear_dead_observations([keyframe, other, *here, *there])
