"""Culling of redundant keyframes, so that hovering and return passes do not grow the map.

A keyframe is culled if another is closer than the keyframe spacing and three others, or so many as
are given, observe nearly all of its points at the same or a finer scale (after Mur-Artal & Tardos,
T-RO 2015). Frames and cloud chunks that refer to it follow its anchor, the nearest keyframe.
"""

from __future__ import annotations

import numpy as np

from companion.slam.features.orb_features import Ints
from companion.slam.map.map_points import N_OBSERVERS_KEPT
from companion.slam.map.sparse_map import Keyframe, Retired, SlamMap

MIN_REDUNDANT_RATIO, MIN_OBSERVERS = 0.9, 3
MAX_COARSER_LEVELS = 1
"""Pyramid levels by which another observation may be coarser."""
MAX_CANDIDATES, N_OTHERS = 12, 20
N_NEWEST_KEPT, N_OLDEST_KEPT = 4, 5
"""Tracking uses the newest keyframes; the oldest fix the gauge."""
MIN_SHARED = 30


def cull_keyframes(
    slam_map: SlamMap, newest: Keyframe, spacing_deg: float, n_observers: int = MIN_OBSERVERS
) -> list[int]:
    """Cull redundant keyframes around the newest one, newer ones first; returns their ids.

    A keyframe is a candidate within `spacing_deg` of another, as an angle seen from its points, and
    redundant where `n_observers` others observe these.
    """
    spacing = float(np.tan(np.radians(spacing_deg)))
    keys = list(slam_map.keyframes)
    protected = {*keys[:N_OLDEST_KEPT], *keys[-N_NEWEST_KEPT:], newest.keyframe_id, *slam_map.held}
    _, points = slam_map.observations_of(newest)
    near = [
        k for _, k in slam_map.covisible(points, MIN_SHARED)[:MAX_CANDIDATES] if k not in protected
    ]
    culled = []
    for key in sorted(near, reverse=True):
        keyframe = slam_map.keyframes[key]
        anchor = _nearest(slam_map, keyframe, spacing)
        if anchor is not None and _redundant(slam_map, keyframe, n_observers):
            retire(slam_map, keyframe, anchor)
            culled.append(key)
    return culled


def _nearest(slam_map: SlamMap, keyframe: Keyframe, spacing: float) -> Keyframe | None:
    """The nearest keyframe in space, if close enough and sharing at least half of the points."""
    (key,) = slam_map.nearest(keyframe.centre, 1, {keyframe.keyframe_id})
    other = slam_map.keyframes[key]
    _, points = slam_map.observations_of(keyframe)
    if len(points) < MIN_SHARED:
        return None
    depth = float(np.median(keyframe.camera_from_map.apply(slam_map.positions[points])[:, 2]))
    apart = float(np.linalg.norm(other.centre - keyframe.centre))
    if apart > spacing * depth:
        return None
    shared = np.isin(points, slam_map.observations_of(other)[1])
    return other if np.count_nonzero(shared) >= 0.5 * len(points) else None


def _redundant(slam_map: SlamMap, keyframe: Keyframe, n_observers: int) -> bool:
    features, points = slam_map.observations_of(keyframe)
    octave = np.full(slam_map.n_points + 1, -1, np.int64)
    octave[points] = keyframe.features.octaves[features]
    others = np.zeros(slam_map.n_points, np.int64)
    for _, key in slam_map.covisible(points, MIN_OBSERVERS)[: N_OTHERS + 1]:
        if key == keyframe.keyframe_id:
            continue
        other = slam_map.keyframes[key]
        theirs, ids = slam_map.observations_of(other)
        as_fine = other.features.octaves[theirs] <= octave[ids] + MAX_COARSER_LEVELS
        others[ids[as_fine & (octave[ids] >= 0)]] += 1
    seen_often = int(np.count_nonzero(others[points] >= n_observers))
    return seen_often >= MIN_REDUNDANT_RATIO * len(points)


def retire(slam_map: SlamMap, keyframe: Keyframe, anchor: Keyframe) -> None:
    """Remove a keyframe from the map; its pose is from now on relative to its anchor."""
    key = keyframe.keyframe_id
    anchor_from_keyframe = anchor.camera_from_map @ keyframe.camera_from_map.inverse()
    for old, retired in slam_map.retired.items():
        if retired.anchor_id == key:
            pose = anchor_from_keyframe @ retired.anchor_from_camera
            slam_map.retired[old] = Retired(anchor.keyframe_id, pose)
    slam_map.retired[key] = Retired(anchor.keyframe_id, anchor_from_keyframe)
    _, points = slam_map.observations_of(keyframe)
    slam_map.remove_observations(keyframe, np.arange(len(keyframe.point_ids)))
    _drop_observer(slam_map, key, points)
    keyframe.grey = None
    del slam_map.keyframes[key]
    slam_map.keyframes_moved([key])


def _drop_observer(slam_map: SlamMap, key: int, points: Ints) -> None:
    """Free a culled keyframe's slot in the ring of observers, without overwriting another."""
    own = slam_map.observers[points] == key
    points, at = points[own.any(1)], own[own.any(1)].argmax(1)
    following = slam_map.n_observers[points] % N_OBSERVERS_KEPT
    slam_map.observers[points, at] = slam_map.observers[points, following]
    slam_map.observers[points, following] = -1
