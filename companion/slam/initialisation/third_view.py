"""Third-view consistency check of a two-view reconstruction."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from companion.geometry.transforms import Array, Pose, interpolate_rotation
from companion.slam.features.matching import match_descriptors
from companion.slam.features.orb_features import Ints
from companion.slam.features.view import View
from companion.slam.optimisation.pose_refinement import refine_pose

MIN_OBSERVED = 25
"""Points that a third view must observe to be able to reject."""
MIN_INLIER_RATIO = 0.5


def middle_view(views: Iterable[View], first: View, second: View) -> View | None:
    """The view nearest in time to the middle between two; None if there is none between."""
    half_ns = (first.t_ns + second.t_ns) // 2
    inside = [v for v in views if first.seq < v.seq < second.seq]
    return min(inside, key=lambda v: abs(v.t_ns - half_ns), default=None)


def third_view_rejects(
    third: View, first: View, second: View, points_map: Array, features_first: Ints
) -> bool:
    """True if no pose of a view between two fits their points (N, 3).

    `first` and `second` have poses; `features_first` (N,) observe the points.
    """
    ia, ib = match_descriptors(first.features, third.features)
    point_of = np.full(len(first.features), -1)
    point_of[features_first] = np.arange(len(features_first))
    shown = point_of[ia] >= 0
    if np.count_nonzero(shown) < MIN_OBSERVED:
        return False
    share = (third.t_ns - first.t_ns) / max(second.t_ns - first.t_ns, 1)
    a, b = first.camera_from_map, second.camera_from_map
    rotation = interpolate_rotation(a.rotation, b.rotation, share)
    centre = -(1 - share) * a.rotation.T @ a.translation - share * b.rotation.T @ b.translation
    seen = ib[shown]
    _, agree, _ = refine_pose(
        Pose(rotation, -rotation @ centre), points_map[point_of[ia[shown]]],
        third.features.normalised[seen], third.features.whitening[seen],
    )  # fmt: skip
    return float(np.mean(agree)) < MIN_INLIER_RATIO
