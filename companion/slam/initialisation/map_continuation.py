"""Continuation of a map by a two-view reconstruction from its last tracked frame.

A camera that rotates faster than its map grows loses tracking although consecutive images overlap:
the reconstruction is scaled by the depths of points that the map already has.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.geometry.transforms import Array, Pose
from companion.slam.features.orb_features import Bools, Ints
from companion.slam.features.view import View
from companion.slam.initialisation.bootstrap import TwoViewReconstruction
from companion.slam.map.sparse_map import SlamMap

MIN_SHARED, MAX_SPREAD = 8, 0.25
"""Shared points required, and the largest relative spread of their depth ratios (1.4826 MAD)."""


@dataclass(frozen=True, slots=True, eq=False)
class MapContinuation:
    """A two-view reconstruction placed in a map.

    `known` (N,) marks the points that the map has, as `known_points`; `points_map` (M, 3) are the
    others, observed by `features_first` (M,) of the first view.
    """

    second_from_map: Pose
    known: Bools
    known_points: Ints
    points_map: Array
    features_first: Ints


def continuation_of(
    slam_map: SlamMap, tracked: View, start: TwoViewReconstruction
) -> MapContinuation | None:
    """Place a reconstruction in the map that its first view was `tracked` in; None if uncertain."""
    if start.first.seq != tracked.seq:
        return None
    ids = tracked.point_ids[start.features_first]
    known = (ids >= 0) & slam_map.alive[np.maximum(ids, 0)]
    if np.count_nonzero(known) < MIN_SHARED:
        return None
    in_first = start.first.camera_from_map.apply(start.points_map)
    depth = tracked.camera_from_map.apply(slam_map.positions[ids[known]])[:, 2]
    ratio = depth / in_first[known, 2]
    scale = float(np.median(ratio))
    if scale <= 0 or 1.4826 * float(np.median(np.abs(ratio / scale - 1.0))) > MAX_SPREAD:
        return None
    second_from_first = start.second.camera_from_map @ start.first.camera_from_map.inverse()
    second_from_first = Pose(second_from_first.rotation, scale * second_from_first.translation)
    points_map = tracked.camera_from_map.inverse().apply(scale * in_first[~known])
    return MapContinuation(
        second_from_first @ tracked.camera_from_map, np.asarray(known, bool), ids[known],
        points_map, start.features_first[~known],
    )  # fmt: skip
