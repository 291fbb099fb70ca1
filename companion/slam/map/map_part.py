"""Extraction of the part of a map around a keyframe, and reconstruction of a map from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from companion.slam.compiled.patch_alignment import STORED
from companion.slam.features.orb_features import Ints
from companion.slam.map.map_points import N_OBSERVERS_KEPT, PointArrays
from companion.slam.map.sparse_map import Keyframe, SlamMap

FEATURE_BYTES = 8 + 1 + 4 + 32 + 4 + 4 + 8 + 16
"""Size of a keyframe feature in a file: pixels, octave, angle, descriptor, its point, the point
that it was refined for, refined coordinates and their whitening."""
POINT_BYTES = 24 + 32 + 12 + 8 + 4 + 4 + 8 + 8 + 16 + 8 + 1 + STORED**2
"""Size of a point in a file, most of it the patch."""


@dataclass(frozen=True, slots=True, eq=False)
class MapPart:
    """Keyframes (ordered by id) and the points that they observe.

    `point_ids` and `refined_for` of the keyframes index `points`.
    """

    first_keyframe_id: int
    level: bool
    keyframes: tuple[Keyframe, ...]
    points: PointArrays
    is_far: bool = False
    """Patches lie in a file, or may: they are read where they are."""


def part_around(slam_map: SlamMap, keyframe: Keyframe, most_bytes: int) -> MapPart:
    """The part of the map around a keyframe that takes at most `most_bytes` in a file.

    Keyframes are added by covisibility, then by distance. The caller must hold the map; the result
    is a copy.
    """
    chosen: dict[int, Keyframe] = {}
    wanted = np.zeros(slam_map.n_points, bool)
    left = most_bytes
    for key in _by_nearness(slam_map, keyframe):
        if key in chosen:
            continue
        near = slam_map.keyframes[key]
        _, ids = slam_map.observations_of(near)
        n_new = int(np.count_nonzero(~wanted[ids]))
        left -= FEATURE_BYTES * len(near.point_ids) + POINT_BYTES * n_new
        if left < 0:
            break
        chosen[key] = near
        wanted[ids] = True
    return part_of(slam_map, chosen)


def part_of(slam_map: SlamMap, chosen: Mapping[int, Keyframe]) -> MapPart:
    """The part of the map that some keyframes, by id, and their points are.

    A copy, but for what is not changed any more.
    """
    wanted = np.zeros(slam_map.n_points, bool)
    for keyframe in chosen.values():
        wanted[slam_map.observations_of(keyframe)[1]] = True
    ids = np.flatnonzero(wanted)
    index = np.full(slam_map.n_points + 1, -1)  # its last is that of no point
    index[ids] = np.arange(len(ids))
    copies = (
        replace(
            k, point_ids=index[k.point_ids],
            refined_for=np.where(k.refined_for == k.point_ids, index[k.point_ids], -1),
            seen=k.seen_apart, grey=None, is_far=False,
        )
        for _, k in sorted(chosen.items())
    )  # fmt: skip
    return MapPart(
        slam_map.first_keyframe_id, slam_map.level, tuple(copies), slam_map.points_of(ids)
    )


def _by_nearness(slam_map: SlamMap, keyframe: Keyframe) -> chain[int]:
    _, ids = slam_map.observations_of(keyframe)
    shared = [key for _, key in slam_map.covisible(ids)]
    nearest = slam_map.nearest(keyframe.centre, len(slam_map.keyframes), set())
    return chain([keyframe.keyframe_id], shared, nearest)


def map_of(part: MapPart, scale_factor: float, n_levels: int, shift_ns: int = 0) -> SlamMap:
    """A map of its own from a part, keyframe times shifted by `shift_ns`."""
    slam_map = SlamMap(
        scale_factor, n_levels, first_keyframe_id=part.first_keyframe_id, level=part.level
    )
    slam_map.load_points(part.points, part.is_far)
    for kept in part.keyframes:
        keyframe = replace(kept, t_ns=kept.t_ns + shift_ns, point_ids=kept.point_ids.copy())
        slam_map.keyframes[keyframe.keyframe_id] = keyframe
        features = np.flatnonzero(keyframe.point_ids >= 0)
        _observe(slam_map, keyframe, keyframe.point_ids[features])
    slam_map.keyframes_moved()
    return slam_map


def _observe(slam_map: SlamMap, keyframe: Keyframe, points: Ints) -> None:
    """Add `keyframe` to the observers of points, as `SlamMap.add_observations` does."""
    slam_map.observers[points, slam_map.n_observers[points] % N_OBSERVERS_KEPT] = (
        keyframe.keyframe_id
    )
    slam_map.n_observers[points] += 1
