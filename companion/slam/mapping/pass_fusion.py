"""Fusion of the points that passes over the same ground have each made of one corner."""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Array
from companion.slam.features.orb_features import Ints
from companion.slam.map.local_map import Projector
from companion.slam.map.patch_refinement import align_points, move_features
from companion.slam.map.sparse_map import Keyframe, SlamMap

RADIUS_PX, MAX_BITS = 3.0, 50
"""Largest distance from where a point is predicted, at pyramid level 0, and of descriptors: as of
the fusion in flight."""
MAX_APART_PX = 4.0
"""Two sigmas of two corners at the level of a patch, each of 1 to 2 px there."""
N_NEAR = 60
"""Keyframes looked at about each one: 2 ms, in a map of any size."""


def fuse_passes(slam_map: SlamMap, projector: Projector) -> int:
    """Unite points of keyframes that are near each other and share none; how many were dropped.

    Two points become one only where their stored patches align, and what observed one is moved to
    the corner of the other: they are up to 2 px apart, which would bend the map. Features that
    observe nothing yet are left so: a detected corner is not aligned, and the scale of a flight
    around a building was 0.1 % worse by them.
    """
    pairs = one_to_one(
        np.concatenate(
            [np.zeros((0, 2), np.int64)]
            + [
                _candidates(slam_map, projector, keyframe)
                for key, keyframe in slam_map.keyframes.items()
                if key not in slam_map.held
            ]
        )
    )
    fewer = slam_map.n_observers[pairs[:, 0]] < slam_map.n_observers[pairs[:, 1]]
    pairs[fewer] = pairs[fewer, ::-1]
    # what a keyframe that lies in a file observes stays as it is
    named = slam_map.is_named[pairs]
    pairs[named[:, 1]] = pairs[named[:, 1], ::-1]
    pairs = pairs[~named.all(1)]
    apart_px, sure = align_points(slam_map, pairs[:, 0], pairs[:, 1], MAX_APART_PX)
    unite(slam_map, pairs[sure, 0], pairs[sure, 1], apart_px[sure])
    return int(np.count_nonzero(sure))


def _candidates(slam_map: SlamMap, projector: Projector, keyframe: Keyframe) -> Ints:
    """Points (M, 2) of other passes, found at features of points of this keyframe, and those."""
    _, seen = slam_map.observations_of(keyframe)
    known = {k for _, k in slam_map.covisible(seen)} | {keyframe.keyframe_id} | slam_map.held
    near = [k for k in slam_map.nearest(keyframe.centre, N_NEAR, set()) if k not in known]
    if not near:
        return np.zeros((0, 2), np.int64)
    theirs = [slam_map.observations_of(slam_map.keyframes[k])[1] for k in near]
    points = np.setdiff1d(np.concatenate(theirs), seen)
    visible = projector.visible(slam_map, keyframe.camera_from_map, points)
    ids, features = projector.search(slam_map, visible, keyframe.features, RADIUS_PX, MAX_BITS)
    own = keyframe.point_ids[features]
    alive = (own >= 0) & slam_map.alive[np.maximum(own, 0)]
    return np.stack([ids[alive], own[alive]], 1)


def one_to_one(pairs: Ints) -> Ints:
    """The pairs found most often, in which each point is once; the lower id first."""
    distinct, often = np.unique(np.sort(pairs, axis=1), axis=0, return_counts=True)
    taken: set[int] = set()
    out = []
    for pair in distinct[np.argsort(-often, kind="stable")].tolist():
        if taken.isdisjoint(pair):
            taken.update(pair)
            out.append(pair)
    return np.array(out, np.int64).reshape(-1, 2)


def unite(slam_map: SlamMap, kept: Ints, dropped: Ints, apart_px: Array) -> None:
    """Let points take over all observations of others, moved by what is apart in their views."""
    row = np.full(slam_map.n_points, -1)
    row[dropped] = np.arange(len(dropped))
    for keyframe in slam_map.keyframes.values():
        features, ids = slam_map.observations_of(keyframe)
        features, at = features[row[ids] >= 0], row[ids][row[ids] >= 0]
        if not len(features):
            continue
        move_features(slam_map, keyframe, features, dropped[at], apart_px[at])
        keyframe.refined_for[features] = -1
        twice = np.isin(kept[at], keyframe.point_ids)
        slam_map.add_observations(keyframe, features[~twice], kept[at[~twice]])
        slam_map.remove_observations(keyframe, features[twice])
    slam_map.n_visible[kept] += slam_map.n_visible[dropped]
    slam_map.n_found[kept] += slam_map.n_found[dropped]
    slam_map.alive[dropped] = False
    slam_map.n_observers[dropped] = 0
