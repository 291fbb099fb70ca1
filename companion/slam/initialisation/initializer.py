"""Two-view initialisation: relative pose and points from two images.

The pose is selected among competing hypotheses by its reprojection cost and the autopilot's
relative rotation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.geometry.transforms import Array, Pose, angle_between
from companion.slam.features.orb_features import Bools, Features, Ints
from companion.slam.features.triangulation import consistent, triangulate
from companion.slam.optimisation.bundle_adjustment import Bundle, adjust
from companion.slam.optimisation.motion_hypotheses import motion_hypotheses
from companion.slam.optimisation.rotation_factor import RelativeRotationFactor

MIN_POINTS = 60
GAMMA = 5.991
PURE_ROTATION_PX, MAX_PURE_ROTATION_RATIO = 2.0, 0.5
PRIOR_ROTATION_RAD, PRIOR_ROTATION_RATIO = np.radians(0.5), 0.1
"""Tolerance of the autopilot's relative rotation: at least, and as a ratio of its angle."""
HYPOTHESIS_INLIER_RATIO = 0.6
"""Hypotheses with fewer inliers than this ratio of the best do not compete."""
MIN_COST_RATIO = 1.15
"""Cost of any competing hypothesis relative to the best, for that to be unambiguous."""


@dataclass(frozen=True, slots=True, eq=False)
class TwoViewGeometry:
    """Two-view geometry: `b_from_a` with a unit baseline, points (N, 3) in a."""

    b_from_a: Pose
    points_a: Array
    features_a: Ints
    features_b: Ints
    parallax_rad: float
    planar: bool


def initialise(
    a: Features,
    b: Features,
    index_a: Ints,
    index_b: Ints,
    focal_px: float,
    seed: int,
    attitudes: tuple[Array, Array] | None,
    min_parallax_rad: float,
) -> TwoViewGeometry | None:
    """Relative pose and points from matches `index_a`, `index_b`; None when ambiguous.

    `attitudes` are `ned_from_camera` of a and b, where measured.
    """
    if len(index_a) < MIN_POINTS:
        return None
    xa, xb = a.normalised[index_a], b.normalised[index_b]
    rotation_prior = None if attitudes is None else attitudes[1].T @ attitudes[0]
    rotation_only = _explained_by_rotation(xa, xb, focal_px, rotation_prior)
    if np.mean(rotation_only) > MAX_PURE_ROTATION_RATIO:
        return None
    candidates, planar = motion_hypotheses(xa, xb, focal_px, seed, attitudes)
    best = _best(candidates, a, b, index_a, index_b, rotation_prior)
    if best is None:
        return None
    found = _refined(best, a, b, index_a, index_b, rotation_prior, min_parallax_rad)
    if found is None:
        return None
    pose, points, agree, shown, parallax_rad = found
    # outliers fit no rotation either, but are known only now; with no prior the hypotheses competed
    if rotation_prior is not None and np.sum(rotation_only) > MAX_PURE_ROTATION_RATIO * np.sum(
        rotation_only | agree
    ):
        return None
    return TwoViewGeometry(
        pose, points[shown], index_a[shown], index_b[shown], parallax_rad, planar
    )


def _explained_by_rotation(
    xa: Array, xb: Array, focal_px: float, rotation_prior: Array | None
) -> Bools:
    """Mask (N,) of matches explained by rotation alone, which carry no baseline.

    None if that rotation contradicts `rotation_prior`: a short translation over a plane resembles a
    rotation.
    """
    rays_a, rays_b = _unit_rays(xa), _unit_rays(xb)
    weight = np.ones(len(rays_a))
    error_px = np.zeros(len(rays_a))
    rotation = np.eye(3)
    for _ in range(15):  # robust Kabsch
        u, _, vt = np.linalg.svd((rays_b * weight[:, None]).T @ rays_a)
        rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        error_px = np.linalg.norm(rays_b - rays_a @ rotation.T, axis=1) * focal_px
        weight = 1.0 / (1.0 + (error_px / PURE_ROTATION_PX) ** 2) ** 2
    if rotation_prior is not None:
        off_rad = float(PRIOR_ROTATION_RAD) + PRIOR_ROTATION_RATIO * angle_between(
            rotation_prior, np.eye(3)
        )
        if angle_between(rotation, rotation_prior) >= off_rad:
            return np.zeros(len(xa), bool)
    return np.asarray(error_px < PURE_ROTATION_PX, bool)


def _unit_rays(normalised: Array) -> Array:
    rays = np.c_[normalised, np.ones(len(normalised))]
    out: Array = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return out


def _best(
    candidates: list[Pose], a: Features, b: Features, index_a: Ints, index_b: Ints,
    rotation_prior: Array | None,
) -> Pose | None:  # fmt: skip
    scored = []
    for pose in candidates:
        points, _ = triangulate(a.normalised[index_a], b.normalised[index_b], pose)
        ok = consistent(
            points, pose, a.normalised[index_a], b.normalised[index_b],
            a.whitening[index_a], b.whitening[index_b], 9.0,
        )  # fmt: skip
        scored.append((int(ok.sum()), pose))
    if not scored:
        return None
    scored.sort(key=lambda s: -s[0])
    top, pose = scored[0]
    if top < MIN_POINTS // 2:
        return None
    if rotation_prior is not None:
        factor = RelativeRotationFactor.with_typical_errors(
            np.array([1]), np.array([0]), rotation_prior[None]
        )

        def cost(pose: Pose) -> float:
            _, off = factor.errors(np.stack([np.eye(3), pose.rotation]))
            return _unexplained(pose, a, b, index_a, index_b) + float(off[0]) ** 2

        return min((p for n, p in scored if n > HYPOTHESIS_INLIER_RATIO * top), key=cost)
    return _most_likely(
        [p for n, p in scored if n > HYPOTHESIS_INLIER_RATIO * top], a, b, index_a, index_b
    )


def _most_likely(
    poses: list[Pose], a: Features, b: Features, index_a: Ints, index_b: Ints
) -> Pose | None:
    """The pose of least cost, each refined first; None if another is nearly as good."""
    best: list[tuple[float, Pose]] = []
    for start in poses:
        pose: Pose | None = start
        for limit in (16.0, 9.0):
            if pose is not None:
                pose = _adjusted(pose, a, b, index_a, index_b, limit)
        if pose is None:
            continue
        best.append((_unexplained(pose, a, b, index_a, index_b), pose))
    if not best:
        return None
    best.sort(key=lambda c: c[0])
    cost, pose = best[0]
    for other, competitor in best[1:]:
        different = (
            angle_between(competitor.rotation, pose.rotation) > np.radians(1.5)
            or float(competitor.translation @ pose.translation) < 0.95
        )
        if different and other < MIN_COST_RATIO * cost + 30.0:
            return None
    return pose


def _unexplained(pose: Pose, a: Features, b: Features, index_a: Ints, index_b: Ints) -> float:
    """Sum of squared errors of all matches in both views, truncated at the outlier threshold."""
    xa, xb = a.normalised[index_a], b.normalised[index_b]
    points, _ = triangulate(xa, xb, pose)
    in_b = pose.apply(points)
    total = np.zeros(len(points))
    with np.errstate(invalid="ignore", divide="ignore"):
        for p, seen, white in (
            (points, xa, a.whitening[index_a]), (in_b, xb, b.whitening[index_b])
        ):  # fmt: skip
            error = np.matmul(white, (p[:, :2] / p[:, 2:] - seen)[..., None])[..., 0]
            total += (error * error).sum(1)
        before = (points[:, 2] > 0) & (in_b[:, 2] > 0)
    return float(np.where(before & (total < 2 * GAMMA), total, 2 * GAMMA).sum())


def _adjusted(
    pose: Pose, a: Features, b: Features, index_a: Ints, index_b: Ints, limit: float,
    rotation_prior: Array | None = None,
) -> Pose | None:  # fmt: skip
    """Pose with a unit baseline, bundle-adjusted on its inliers and on `rotation_prior`."""
    points, _ = triangulate(a.normalised[index_a], b.normalised[index_b], pose)
    ok = consistent(
        points, pose, a.normalised[index_a], b.normalised[index_b],
        a.whitening[index_a], b.whitening[index_b], limit,
    )  # fmt: skip
    ia, ib, pts = index_a[ok], index_b[ok], points[ok]
    n = len(ia)
    if n < MIN_POINTS // 2:
        return None
    factor = (
        None
        if rotation_prior is None
        else RelativeRotationFactor.with_typical_errors(
            np.array([1]), np.array([0]), rotation_prior[None]
        )
    )
    bundle = Bundle(
        [pose, Pose.identity()], 1, pts,
        np.repeat(np.array([0, 1]), n), np.tile(np.arange(n), 2),
        np.r_[b.normalised[ib], a.normalised[ia]], np.r_[b.whitening[ib], a.whitening[ia]],
        () if factor is None else (factor,),
    )  # fmt: skip
    adjusted = adjust(bundle, 12)
    scale = 1.0 / max(float(np.linalg.norm(adjusted.poses[0].translation)), 1e-12)
    return Pose(adjusted.poses[0].rotation, adjusted.poses[0].translation * scale)


def _refined(
    pose: Pose, a: Features, b: Features, index_a: Ints, index_b: Ints,
    rotation_prior: Array | None, min_parallax_rad: float,
) -> tuple[Pose, Array, Bools, Bools, float] | None:  # fmt: skip
    """Pose, points (N, 3), masks of inliers and of those with parallax, and the parallax in rad."""
    for limit in (16.0, 5.991):
        adjusted = _adjusted(pose, a, b, index_a, index_b, limit, rotation_prior)
        if adjusted is None:
            return None
        pose = adjusted
    points, cosine = triangulate(a.normalised[index_a], b.normalised[index_b], pose)
    ok = consistent(
        points, pose, a.normalised[index_a], b.normalised[index_b],
        a.whitening[index_a], b.whitening[index_b],
    )  # fmt: skip
    if ok.sum() < MIN_POINTS or ok.sum() < 0.5 * len(index_a):
        return None
    parallax = float(np.arccos(np.clip(np.quantile(cosine[ok], 0.3), -1, 1)))
    if parallax < min_parallax_rad:
        return None
    shown = ok & (cosine < np.cos(min(0.3 * min_parallax_rad, np.radians(0.3))))
    return pose, points, ok, shown, parallax
