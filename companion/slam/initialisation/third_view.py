"""Third-view consistency check of a two-view reconstruction, and of what competes with it."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from companion.geometry.transforms import Array, Pose, interpolate_rotation
from companion.slam.features.matching import match_descriptors
from companion.slam.features.view import View
from companion.slam.initialisation.initializer import TwoViewGeometry
from companion.slam.optimisation.pose_refinement import CHI2_2D, refine_pose

MIN_OBSERVED = 25
"""Points that a third view must observe to be able to judge."""
MIN_INLIER_RATIO = 0.5
MAX_ERROR_RATIO = 1.1
"""Error of a third view by the best geometry, relative to that by a competing one. Over what is
nearly a plane both fit it alike."""


def middle_view(views: Iterable[View], first: View, second: View) -> View | None:
    """The view nearest in time to the middle between two; None if there is none between."""
    half_ns = (first.t_ns + second.t_ns) // 2
    inside = [v for v in views if first.seq < v.seq < second.seq]
    return min(inside, key=lambda v: abs(v.t_ns - half_ns), default=None)


def third_view_rejects(
    third: View | None, first: View, second: View, found: TwoViewGeometry
) -> bool:
    """True if no pose of a view between two fits their points, or a competing geometry's better.

    A geometry with competing ones is rejected too where no third view can tell.
    """
    best = None if third is None else _errors(third, first, second, found)
    if third is None or best is None:
        return bool(found.competing)
    if np.mean(best < CHI2_2D) < MIN_INLIER_RATIO:
        return True
    for other in found.competing:
        errors = _errors(third, first, second, other)
        if errors is not None and _cost(best) > MAX_ERROR_RATIO * _cost(errors):
            return True
    return False


def _cost(errors: Array) -> float:
    return float(np.minimum(errors, CHI2_2D).mean())


def _errors(third: View, first: View, second: View, found: TwoViewGeometry) -> Array | None:
    """Squared errors (M,) of the points that a third view observes, at its best pose."""
    ia, ib = match_descriptors(first.features, third.features)
    point_of = np.full(len(first.features), -1)
    point_of[found.features_a] = np.arange(len(found.features_a))
    shown = point_of[ia] >= 0
    if np.count_nonzero(shown) < MIN_OBSERVED:
        return None
    share = (third.t_ns - first.t_ns) / max(second.t_ns - first.t_ns, 1)
    rotation = interpolate_rotation(np.eye(3), found.b_from_a.rotation, share)
    centre = share * found.b_from_a.inverse().translation
    points, features, seen = found.points_a[point_of[ia[shown]]], third.features, ib[shown]
    normalised, whitening = features.normalised[seen], features.whitening[seen]
    pose, _, _ = refine_pose(Pose(rotation, -rotation @ centre), points, normalised, whitening)
    in_third = pose.apply(points)
    with np.errstate(invalid="ignore", divide="ignore"):
        error = in_third[:, :2] / in_third[:, 2:] - normalised
    squared = (np.matmul(whitening, error[..., None])[..., 0] ** 2).sum(1)
    return np.where(in_third[:, 2] > 0, squared, np.inf)
