"""Local mapping of a keyframe: triangulation, fusion, bundle adjustment, culling."""

from __future__ import annotations

from collections.abc import Callable, Collection
from itertools import islice

import numpy as np

from companion.geometry.camera import Camera
from companion.messages import Bytes
from companion.slam.features.matching import match_epipolar
from companion.slam.features.orb_features import Bools, Ints
from companion.slam.features.patches import image_levels
from companion.slam.features.triangulation import consistent, triangulate
from companion.slam.map.local_map import Projector
from companion.slam.map.patch_refinement import refine_features
from companion.slam.map.sparse_map import Keyframe, SlamMap
from companion.slam.mapping.culling import cull_keyframes
from companion.slam.mapping.map_adjustment import (
    MAX_VARIABLE,
    DisplacementSource,
    apply_result,
    apply_result_later,
    build_problem,
    is_without_attitude,
    no_displacements,
    partition,
)
from companion.slam.mapping.mapping_worker import MapLock
from companion.slam.mapping.pass_fusion import fuse_passes
from companion.slam.mapping.point_fusion import N_NEIGHBOURS, PointFusion
from companion.slam.mapping.turned_view import (
    MIN_SEEN,
    is_turn,
    median_parallax_deg,
    on_level_ground,
)
from companion.slam.optimisation.bundle_adjustment import adjust

MIN_PARALLAX_RAD = np.radians(0.8)
WINDOW, N_FIXED = 10, 10
"""Keyframes adjusted together, and older ones with the same points that are held fixed. Half or
twice as many of either change the error of the sample flight, 53 mm, by 4 mm at most."""
ITERATIONS = 6
"""Iterations of a local adjustment, most of which the next keyframe repeats. 3 and 12 end within
5 mm of it."""
KEYFRAME_SPACING_DEG = 1.0
"""Keyframes closer than this are culled if redundant: a third of what tracking inserts one for."""
FINAL_ITERATIONS, FINAL_ROUNDS = 8, 2
"""Iterations and rounds of the adjustment at a flight's end. An iteration more changes nothing; a
round more begins without the observations that the last one found wrong, which until then pull at
a long and thin map: around a building 0.031 m with one round, 0.027 with two and with three."""
OF_LARGE_MAP = 2
"""Iterations, in one round, with more than MAX_VARIABLE keyframes: four take a second a hundred."""
N_IMAGES_KEPT = 100
"""Images of older keyframes are dropped; their features are no longer refined by patches."""


class Mapper:
    """Local mapping, run once per keyframe.

    `part_done` is called after each window of a global adjustment: keyframes that were read for it
    need not stay in memory.
    """

    def __init__(
        self, camera: Camera, slam_map: SlamMap, map_lock: MapLock,
        displacements_of: DisplacementSource = no_displacements,
        part_done: Callable[[], None] = lambda: None,
    ) -> None:  # fmt: skip
        self._camera, self._displacements_of = camera, displacements_of
        self._map_lock, self._part_done = map_lock, part_done
        self._map = slam_map
        self.fusion = PointFusion(camera, slam_map, map_lock)

    def add(self, keyframe: Keyframe) -> list[int]:
        """Insert a keyframe, whose tracked points are set; ids of the keyframes culled for it."""
        slam_map = self._map
        slam_map.keyframes[keyframe.keyframe_id] = keyframe
        slam_map.keyframes_moved([keyframe.keyframe_id])
        for key in islice(reversed(slam_map.keyframes), N_IMAGES_KEPT, N_IMAGES_KEPT + 2):
            slam_map.keyframes[key].grey = None
        _, points = slam_map.observations_of(keyframe)
        neighbours = [
            slam_map.keyframes[k]
            for _, k in slam_map.covisible(points, 10)
            if k != keyframe.keyframe_id
        ][:N_NEIGHBOURS]
        slam_map.update_geometry(points, [*reversed(neighbours), keyframe])
        assert keyframe.grey is not None
        levels = image_levels(keyframe.grey)
        created = self._triangulate(keyframe, neighbours, levels)
        self._place_on_ground(keyframe, neighbours, levels)
        self.fusion.extend(keyframe, neighbours, created)
        self.fusion.fuse_held(keyframe)
        self._refine([keyframe, *neighbours])
        self.adjust_locally(keyframe)
        self._cull(keyframe)
        slam_map.recycle_ids()
        self._map_lock.yield_to_tracking()
        return cull_keyframes(slam_map, keyframe, KEYFRAME_SPACING_DEG)

    def _refine(self, keyframes: list[Keyframe]) -> None:
        """Refine features by patch alignment that were not refined yet."""
        slam_map = self._map
        for k in keyframes:
            features, points = slam_map.observations_of(k)
            new = (k.refined_for[features] != points) & (
                slam_map.first_seen[points] != k.keyframe_id
            )
            features, points = features[new], points[new]
            if k.grey is None or len(points) == 0:
                continue
            self._map_lock.yield_to_tracking()
            finer, white, _ = refine_features(
                slam_map, k.camera_from_map, k.features, features, points, image_levels(k.grey)
            )
            k.normalised[features], k.whitening[features] = finer, white
            k.refined_for[features] = points

    def _triangulate(
        self, keyframe: Keyframe, neighbours: list[Keyframe], levels: list[Bytes]
    ) -> Ints:
        created = []
        slam_map = self._map
        for other in neighbours:
            self._map_lock.yield_to_tracking()
            free_a = np.flatnonzero(keyframe.point_ids < 0)
            free_b = np.flatnonzero(other.point_ids < 0)
            other_from_here = other.camera_from_map @ keyframe.camera_from_map.inverse()
            depth = np.median(
                keyframe.camera_from_map.apply(
                    slam_map.positions[slam_map.observations_of(keyframe)[1]]
                )[:, 2]
            )
            if np.linalg.norm(other_from_here.translation) < 0.01 * depth:
                continue
            ia, ib = match_epipolar(
                keyframe.features, other.features, free_a, free_b, other_from_here
            )
            if len(ia) == 0:
                continue
            fa, fb = keyframe.features, other.features
            points, cosine = triangulate(fa.normalised[ia], fb.normalised[ib], other_from_here)
            ok = consistent(
                points, other_from_here, fa.normalised[ia], fb.normalised[ib],
                fa.whitening[ia], fb.whitening[ib],
            )  # fmt: skip
            ok &= cosine < np.cos(MIN_PARALLAX_RAD)
            # the same corner is seen at levels that fit its two distances
            da = np.linalg.norm(points, axis=1)
            db = np.linalg.norm(other_from_here.apply(points), axis=1)
            with np.errstate(invalid="ignore"):
                gap = (
                    fa.octaves[ia]
                    - fb.octaves[ib]
                    + np.log(da / db) / np.log(slam_map.scale_factor)
                )
                ok &= np.abs(gap) < 2.0
            ia, ib, points = ia[ok], ib[ok], points[ok]
            if len(ia) == 0:
                continue
            ids = slam_map.add_points(
                keyframe.camera_from_map.inverse().apply(points),
                keyframe.keyframe_id, keyframe.features, ia, levels,
            )  # fmt: skip
            slam_map.add_observations(keyframe, ia, ids)
            slam_map.add_observations(other, ib, ids)
            slam_map.update_geometry(ids, [other, keyframe])
            created.append(ids)
        return np.concatenate(created) if created else np.zeros(0, np.int64)

    def _place_on_ground(
        self, keyframe: Keyframe, neighbours: list[Keyframe], levels: list[Bytes]
    ) -> None:
        """Place points on ground that a turn has brought into view, where that shows few others."""
        slam_map, pose, attitude = self._map, keyframe.camera_from_map, keyframe.ned_from_camera
        _, seen = slam_map.observations_of(keyframe)
        if attitude is None or not neighbours or len(seen) >= MIN_SEEN * len(keyframe.point_ids):
            return
        before = max(neighbours, key=lambda each: each.keyframe_id).camera_from_map
        if not is_turn(median_parallax_deg(slam_map.positions[seen], pose, before), pose, before):
            return
        known = [slam_map.observations_of(each)[1] for each in (keyframe, *neighbours)]
        free = np.flatnonzero(keyframe.point_ids < 0)
        chosen, points = on_level_ground(
            pose.apply(slam_map.positions[np.unique(np.concatenate(known))]), attitude[2],
            keyframe.features.normalised[free],
        )  # fmt: skip
        if len(chosen) == 0:
            return
        features = free[chosen]
        ids = slam_map.add_points(
            pose.inverse().apply(points), keyframe.keyframe_id, keyframe.features, features, levels
        )
        slam_map.add_observations(keyframe, features, ids)
        slam_map.update_geometry(ids, [keyframe])

    def close_loop(self, keyframe: Keyframe, other: Keyframe, seen_there: Ints) -> None:
        """Fuse points of the two sides of a closed loop, and adjust where it was closed."""
        self.fusion.fuse_sides(keyframe, other, seen_there)
        self.adjust_locally(keyframe)

    def adjust_locally(self, keyframe: Keyframe) -> None:
        """Local bundle adjustment over a keyframe, its most covisible ones and all their points.

        Two held keyframes give a part of the map the scale of the rest. Where it is the whole map,
        a second one also holds the error of the two-view geometry, which is large without attitude:
        the damping alone holds the scale then. With attitude metres may be measured by the map,
        whose pose a drift of the scale would move at once.
        """
        slam_map = self._map
        _, points = slam_map.observations_of(keyframe)
        ranked = [slam_map.keyframes[k] for _, k in slam_map.covisible(points, 15)]
        variable = [k for k in ranked if k is not keyframe][: WINDOW - 1] + [keyframe]
        first = min(slam_map.keyframes)
        variable = [
            k for k in variable if k.keyframe_id != first and k.keyframe_id not in slam_map.held
        ]
        if not variable:
            return
        mask = np.zeros(slam_map.n_points, bool)
        for k in variable:
            mask[slam_map.observations_of(k)[1]] = True
        chosen = {k.keyframe_id for k in variable}
        fixed = [
            slam_map.keyframes[k]
            for _, k in slam_map.covisible(np.flatnonzero(mask), 3)
            if k not in chosen
        ][:N_FIXED]
        fixed += self._holding(keyframe, mask, {*chosen, *(k.keyframe_id for k in fixed)})
        if not fixed:  # hold the gauge: position, attitude and scale
            variable.sort(key=lambda k: k.keyframe_id)
            fixed, variable = variable[:2], variable[2:]
            if not variable:
                return
        elif (
            len(fixed) == 1 and len(variable) > 1
            and not (is_without_attitude(slam_map) and len(variable) == len(slam_map.keyframes) - 1)
        ):  # fmt: skip
            variable.sort(key=lambda k: k.keyframe_id)
            fixed, variable = [*fixed, variable[0]], variable[1:]
        self._adjust(variable, fixed, mask)

    def _holding(self, keyframe: Keyframe, mask: Bools, others: set[int]) -> list[Keyframe]:
        """Keyframes of an earlier flight that observe most points of a mask, without others.

        Newer observers of a point displace older ones from the list that covisibility goes by.
        """
        near = [k for k in self.fusion.held_near(keyframe) if k.keyframe_id not in others]
        shared = [np.count_nonzero(mask[self._map.observations_of(k)[1]]) for k in near]
        order = np.argsort(-np.array(shared), kind="stable")[:N_FIXED]
        return [near[int(i)] for i in order if shared[int(i)] >= 3]

    def finish(self) -> None:
        """Join passes over the same ground at a flight's end, and adjust all once more."""
        fuse_passes(self._map, Projector(self._camera))
        if len(self._map.keyframes) > MAX_VARIABLE:
            self.adjust_all(OF_LARGE_MAP)
            return
        for _ in range(FINAL_ROUNDS):
            self.adjust_all(FINAL_ITERATIONS)

    def adjust_all(self, iterations: int, bent: Collection[int] | None = None) -> None:
        """Global bundle adjustment, windowed for long flights; see `partition`."""
        for variable, fixed, mask in partition(self._map, bent):
            self._adjust(variable, fixed, mask, iterations)
            self._part_done()

    def adjust_all_in_background(
        self, iterations: int, yield_point: Callable[[], None], still_valid: Callable[[], bool],
        bent: Collection[int] | None = None,
    ) -> None:  # fmt: skip
        """Global bundle adjustment while the map goes on; called without the map lock.

        `yield_point` is called every few milliseconds and may change the map; results are applied
        while `still_valid` holds. For `bent` see `partition`.
        """
        with self._map_lock.mapping():
            parts = list(partition(self._map, bent))
        for variable, fixed, mask in parts:
            with self._map_lock.mapping():
                stayed = self._map.keyframes.keys()
                variable = [k for k in variable if k.keyframe_id in stayed]
                fixed = [k for k in fixed if k.keyframe_id in stayed]
                mask = np.r_[mask, np.zeros(self._map.n_points - len(mask), bool)]
                if not (variable and fixed):
                    continue
                problem = build_problem(self._map, variable, fixed, mask, self._displacements_of)
            if problem is None:
                continue
            result = adjust(problem.bundle, iterations, yield_point)
            with self._map_lock.mapping():
                if not still_valid():
                    return
                apply_result_later(self._map, problem, result)
            self._part_done()

    def _adjust(
        self,
        variable: list[Keyframe],
        fixed: list[Keyframe],
        mask: Bools,
        iterations: int | None = None,
    ) -> None:
        problem = build_problem(self._map, variable, fixed, mask, self._displacements_of)
        if problem is None:
            return
        if iterations is None:
            result = adjust(problem.bundle, ITERATIONS, self._map_lock.yield_to_tracking)
        else:  # it takes long, and works on copies
            with self._map_lock.released():
                result = adjust(problem.bundle, iterations)
        apply_result(self._map, problem, result)

    def _cull(self, keyframe: Keyframe) -> None:
        """Remove recent points that are seldom found where visible, or have too few observers."""
        slam_map = self._map
        n = slam_map.n_points
        newest = slam_map.born[:n] >= keyframe.keyframe_id - 4
        recent = np.flatnonzero(slam_map.alive[:n] & newest)
        seldom = slam_map.n_found[recent] < 0.25 * slam_map.n_visible[recent]
        settled = slam_map.born[recent] <= keyframe.keyframe_id - 2
        few = settled & (slam_map.n_observers[recent] <= 2)
        slam_map.alive[recent[seldom | few]] = False
        slam_map.clear_dead_observations(
            [slam_map.keyframes[key] for key in islice(reversed(slam_map.keyframes), 30)]
        )
        slam_map.free_patches()
