"""How two views go on with a map that the first of them is part of.

A camera that turns faster than its map grows is lost although each image shows much of the one
before: their points, put to the scale of those that the map knows, carry the map on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.geometry.transforms import Array, Pose
from companion.slam.features.orb_features import Bools, Ints
from companion.slam.features.view import View
from companion.slam.initialisation.bootstrap import Start
from companion.slam.map.sparse_map import SlamMap

MIN_SHARED, MAX_SPREAD = 8, 0.25
"""Points known to both, and how much the ratios of their depths may differ."""


@dataclass(frozen=True, slots=True, eq=False)
class Bridge:
    """A Start in a map: `known` (N,) of its points, as `known_points`; the others' places (M, 3).

    `features_first` (M,) are those of the first view that show the others.
    """

    second_from_map: Pose
    known: Bools
    known_points: Ints
    points_map: Array
    features_first: Ints


def bridge(slam_map: SlamMap, tracked: View, start: Start) -> Bridge | None:
    """Put a Start into a map in which its first view was `tracked`; None where that is unsure."""
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
    return Bridge(
        second_from_first @ tracked.camera_from_map, np.asarray(known, bool), ids[known],
        points_map, start.features_first[~known],
    )  # fmt: skip
