"""The part of a map around a place, copied out of it, and a map made of such a part again."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from companion.slam.compiled.patch_alignment import STORED
from companion.slam.features.orb_features import Ints
from companion.slam.map.sparse_map import RING, Keyframe, PointArrays, SlamMap

FEATURE_BYTES = 8 + 1 + 4 + 32 + 4 + 4 + 8 + 16
"""Of a keyframe's feature in a file: pixels, octave, angle, descriptor, its point and the one that
it was refined for, refined coordinates and their whitening."""
POINT_BYTES = 24 + 32 + 12 + 8 + 4 + 4 + 8 + 8 + 16 + 8 + 1 + STORED**2
"""Of a point in a file, nearly all of it its patch."""


@dataclass(frozen=True, slots=True, eq=False)
class MapPart:
    """Keyframes (in order of their ids) and the points that they see.

    `point_ids` and `refined_for` of the keyframes name points by their index in `points`.
    """

    first_keyframe_id: int
    level: bool
    keyframes: tuple[Keyframe, ...]
    points: PointArrays


def part_around(slam_map: SlamMap, keyframe: Keyframe, most_bytes: int) -> MapPart:
    """The part around a keyframe that takes no more than `most_bytes` in a file.

    First come those that share most points with it, then the nearest. To be called while nobody
    else changes the map; what it returns does not change with the map.
    """
    chosen: dict[int, Keyframe] = {}
    wanted = np.zeros(slam_map.n_points, bool)
    left = most_bytes
    for key in _by_nearness(slam_map, keyframe):
        if key in chosen:
            continue
        near = slam_map.keyframes[key]
        _, ids = slam_map.seen_by(near)
        n_new = int(np.count_nonzero(~wanted[ids]))
        left -= FEATURE_BYTES * len(near.features) + POINT_BYTES * n_new
        if left < 0:
            break
        chosen[key] = near
        wanted[ids] = True
    ids = np.flatnonzero(wanted)
    index = np.full(slam_map.n_points + 1, -1)  # its last is that of no point
    index[ids] = np.arange(len(ids))
    copies = (
        replace(
            k, point_ids=index[k.point_ids],
            refined_for=np.where(k.refined_for == k.point_ids, index[k.point_ids], -1),
            normalised=k.normalised.copy(), whitening=k.whitening.copy(), grey=None,
        )
        for _, k in sorted(chosen.items())
    )  # fmt: skip
    return MapPart(
        slam_map.first_keyframe_id, slam_map.level, tuple(copies), slam_map.points_of(ids)
    )


def _by_nearness(slam_map: SlamMap, keyframe: Keyframe) -> chain[int]:
    _, ids = slam_map.seen_by(keyframe)
    shared = [key for _, key in slam_map.covisible(ids)]
    nearest = slam_map.nearest(keyframe.centre, len(slam_map.keyframes), set())
    return chain([keyframe.keyframe_id], shared, nearest)


def map_of(part: MapPart, scale_factor: float, n_levels: int, shift_ns: int = 0) -> SlamMap:
    """A map of its own with the keyframes and points of a part, their times shifted."""
    slam_map = SlamMap(scale_factor, n_levels, part.first_keyframe_id, part.level)
    slam_map.put_points(part.points)
    for kept in part.keyframes:
        keyframe = replace(kept, t_ns=kept.t_ns + shift_ns, point_ids=kept.point_ids.copy())
        slam_map.keyframes[keyframe.keyframe_id] = keyframe
        features = np.flatnonzero(keyframe.point_ids >= 0)
        _observe(slam_map, keyframe, keyframe.point_ids[features])
    slam_map.poses_changed()
    return slam_map


def _observe(slam_map: SlamMap, keyframe: Keyframe, points: Ints) -> None:
    """Note who sees some points, as `SlamMap.observe` does."""
    slam_map.observers[points, slam_map.n_observers[points] % RING] = keyframe.keyframe_id
    slam_map.n_observers[points] += 1
