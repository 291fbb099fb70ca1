"""Keyframes that show nothing new go, so that hovering and flying to and fro add nothing.

One goes where another stands nearer than keyframes are made apart, and three others show nearly all
of its points as finely or finer (after Mur-Artal & Tardos, T-RO 2015). What hangs on it, a frame's
pose or a chunk of the cloud, goes on with the nearest one.
"""

from __future__ import annotations

import numpy as np

from companion.slam.features.orb_features import Ints
from companion.slam.map.sparse_map import RING, Keyframe, Retired, SlamMap

MIN_SHARE, MIN_OTHERS = 0.9, 3
COARSER = 1
"""Pyramid levels by which another view may be the coarser one."""
N_TRIED, N_OTHERS = 12, 20
NEWEST_KEPT, OLDEST_KEPT = 4, 5
"""Tracking works with the newest ones; the oldest hold position, attitude and scale."""
MIN_SHARED = 30


def cull_keyframes(slam_map: SlamMap, newest: Keyframe, spacing_deg: float) -> list[int]:
    """Retire what became redundant around the newest keyframe, younger ones first; their ids.

    One may go that is nearer than `spacing_deg` to another, as an angle seen from its points.
    """
    spacing = float(np.tan(np.radians(spacing_deg)))
    keys = list(slam_map.keyframes)
    held = {*keys[:OLDEST_KEPT], *keys[-NEWEST_KEPT:], newest.keyframe_id}
    _, points = slam_map.seen_by(newest)
    near = [k for _, k in slam_map.covisible(points, MIN_SHARED)[:N_TRIED] if k not in held]
    gone = []
    for key in sorted(near, reverse=True):
        keyframe = slam_map.keyframes[key]
        stays = _nearest(slam_map, keyframe, spacing)
        if stays is not None and _redundant(slam_map, keyframe):
            retire(slam_map, keyframe, stays)
            gone.append(key)
    return gone


def _nearest(slam_map: SlamMap, keyframe: Keyframe, spacing: float) -> Keyframe | None:
    """The keyframe next to this one in space, where that is near enough and sees the same."""
    (key,) = slam_map.nearest(keyframe.centre, 1, {keyframe.keyframe_id})
    other = slam_map.keyframes[key]
    _, points = slam_map.seen_by(keyframe)
    if len(points) < MIN_SHARED:
        return None
    depth = float(np.median(keyframe.camera_from_map.apply(slam_map.positions[points])[:, 2]))
    apart = float(np.linalg.norm(other.centre - keyframe.centre))
    if apart > spacing * depth:
        return None
    shared = np.isin(points, slam_map.seen_by(other)[1])
    return other if np.count_nonzero(shared) >= 0.5 * len(points) else None


def _redundant(slam_map: SlamMap, keyframe: Keyframe) -> bool:
    features, points = slam_map.seen_by(keyframe)
    octave = np.full(slam_map.n_points + 1, -1, np.int64)
    octave[points] = keyframe.features.octaves[features]
    others = np.zeros(slam_map.n_points, np.int64)
    for _, key in slam_map.covisible(points, MIN_OTHERS)[: N_OTHERS + 1]:
        if key == keyframe.keyframe_id:
            continue
        other = slam_map.keyframes[key]
        theirs, ids = slam_map.seen_by(other)
        as_fine = other.features.octaves[theirs] <= octave[ids] + COARSER
        others[ids[as_fine & (octave[ids] >= 0)]] += 1
    return int(np.count_nonzero(others[points] >= MIN_OTHERS)) >= MIN_SHARE * len(points)


def retire(slam_map: SlamMap, keyframe: Keyframe, stays: Keyframe) -> None:
    """Take a keyframe out of the map; from now on its place is one beside the keyframe `stays`."""
    key = keyframe.keyframe_id
    beside = stays.camera_from_map @ keyframe.camera_from_map.inverse()
    for old, retired in slam_map.retired.items():
        if retired.beside_id == key:
            place = beside @ retired.beside_from_camera
            slam_map.retired[old] = Retired(stays.keyframe_id, place)
    slam_map.retired[key] = Retired(stays.keyframe_id, beside)
    _, points = slam_map.seen_by(keyframe)
    slam_map.forget(keyframe, np.arange(len(keyframe.point_ids)))
    _vacate(slam_map, key, points)
    keyframe.grey = None
    del slam_map.keyframes[key]
    slam_map.poses_changed()


def _vacate(slam_map: SlamMap, key: int, points: Ints) -> None:
    """Let the next keyframe that sees a point be noted where this one was, over no other."""
    own = slam_map.observers[points] == key
    points, at = points[own.any(1)], own[own.any(1)].argmax(1)
    following = slam_map.n_observers[points] % RING
    slam_map.observers[points, at] = slam_map.observers[points, following]
    slam_map.observers[points, following] = -1
