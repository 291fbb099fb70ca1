"""Two-view initialisation: relative pose and points from two images.

The pose is selected among competing hypotheses by its reprojection cost and the autopilot's
relative rotation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from companion.geometry.transforms import Array, Pose, angle_between, nearest_rotation
from companion.slam.features.orb_features import Bools, Features, Ints
from companion.slam.features.triangulation import consistent, triangulate
from companion.slam.initialisation.direction_certainty import direction_sigma_rad
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
PLAUSIBLE_COST = 3.0
"""Cost per match under which a competing hypothesis may be the true one all the same. Two views
leave one degree of freedom per match, so that the truth costs 1 by the noise that is stated. Lens,
rolling shutter and wrong matches may cost twice as much again, which a wrong motion can absorb."""
MAX_DIRECTION_SIGMA_RAD, TURNING_RAD = np.radians(3.0), np.radians(2.0)
"""Largest standard deviation of the direction of motion of a map that begins while the camera turns
by so much between its two views. Where it hardly turns, the next frames see the same ground from
further away and put the map right."""
MAX_FREE_DIRECTION_SIGMA_RAD = np.radians(6.0)
"""The same without attitude, where every turn is found by the same matches; the flattest ground
gives that once views are a few degrees apart."""


@dataclass(frozen=True, slots=True, eq=False)
class TwoViewGeometry:
    """Two-view geometry: `b_from_a` with a unit baseline, points (N, 3) in a.

    `competing` are other geometries of the same matches that explain them well enough to be true.
    """

    b_from_a: Pose
    points_a: Array
    features_a: Ints
    features_b: Ints
    competing: tuple[TwoViewGeometry, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class _Matches:
    """Ideal coordinates (N, 2) of matched features, their whitening (N, 2, 2), and the prior.

    `index_a` and `index_b` (N,) are the features; `rotation_prior` is the rotation `b_from_a` by
    the autopilot, where measured.
    """

    xa: Array
    xb: Array
    whitening_a: Array
    whitening_b: Array
    index_a: Ints
    index_b: Ints
    rotation_prior: Array | None

    def triangulated(self, pose: Pose) -> tuple[Array, Array]:
        """Points in a, and the cosine of each parallax."""
        return triangulate(self.xa, self.xb, pose)

    def consistent(self, points: Array, pose: Pose, max_chi2: float) -> Bools:
        """Mask of points that agree with both views."""
        return consistent(
            points, pose, self.xa, self.xb, self.whitening_a, self.whitening_b, max_chi2
        )


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
    """Relative pose and points from matches `index_a`, `index_b`; None when they cannot tell it.

    `attitudes` are `ned_from_camera` of a and b, where measured.
    """
    if len(index_a) < MIN_POINTS:
        return None
    rotation_prior = None if attitudes is None else attitudes[1].T @ attitudes[0]
    matches = _Matches(
        a.normalised[index_a], b.normalised[index_b], a.whitening[index_a], b.whitening[index_b],
        index_a, index_b, rotation_prior,
    )  # fmt: skip
    rotation_only = _explained_by_rotation(matches, focal_px)
    if np.mean(rotation_only) > MAX_PURE_ROTATION_RATIO:
        return None
    candidates = motion_hypotheses(matches.xa, matches.xb, focal_px, seed, attitudes)
    likely = _likely(candidates, matches)
    if not likely:
        return None
    found = _refined(likely[0], matches, min_parallax_rad)
    if found is None:
        return None
    pose, agree = found
    # outliers fit no rotation either, but are known only now; with no prior the hypotheses competed
    if rotation_prior is not None and np.sum(rotation_only) > MAX_PURE_ROTATION_RATIO * np.sum(
        rotation_only | agree
    ):
        return None
    shown_rad = min(0.3 * min_parallax_rad, float(np.radians(0.3)))
    competing = tuple(_geometry(other, matches, shown_rad) for other in likely[1:])
    return replace(_geometry(pose, matches, shown_rad), competing=competing)


def _explained_by_rotation(matches: _Matches, focal_px: float) -> Bools:
    """Mask (N,) of matches explained by rotation alone, which carry no baseline.

    All False if that rotation contradicts `rotation_prior`: a short translation over a plane
    resembles a rotation.
    """
    rotation, error_px = robust_rotation(matches.xa, matches.xb, focal_px)
    rotation_prior = matches.rotation_prior
    if rotation_prior is not None:
        off_rad = float(PRIOR_ROTATION_RAD) + PRIOR_ROTATION_RATIO * angle_between(
            rotation_prior, np.eye(3)
        )
        if angle_between(rotation, rotation_prior) >= off_rad:
            return np.zeros(len(matches.xa), bool)
    return np.asarray(error_px < PURE_ROTATION_PX, bool)


def robust_rotation(xa: Array, xb: Array, focal_px: float) -> tuple[Array, Array]:
    """Rotation `b_from_a` that explains most matches, and the error (N,) of each in pixels."""
    rays_a, rays_b = _unit_rays(xa), _unit_rays(xb)
    weight = np.ones(len(rays_a))
    error_px = np.zeros(len(rays_a))
    rotation = np.eye(3)
    for _ in range(15):  # robust Kabsch
        rotation = nearest_rotation((rays_b * weight[:, None]).T @ rays_a)
        error_px = np.linalg.norm(rays_b - rays_a @ rotation.T, axis=1) * focal_px
        weight = 1.0 / (1.0 + (error_px / PURE_ROTATION_PX) ** 2) ** 2
    return rotation, error_px


def _unit_rays(normalised: Array) -> Array:
    rays = np.c_[normalised, np.ones(len(normalised))]
    out: Array = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return out


def _likely(candidates: list[Pose], matches: _Matches) -> list[Pose]:
    """The most likely pose, then those that may be true in its place; none if it is uncertain."""
    scored = []
    for pose in candidates:
        scored.append((int(np.sum(_squared_errors(pose, matches) < 2 * GAMMA)), pose))
    if not scored:
        return []
    scored.sort(key=lambda s: -s[0])
    top = scored[0][0]
    if top < MIN_POINTS // 2:
        return []
    competing = [p for n, p in scored if n > HYPOTHESIS_INLIER_RATIO * top]
    if matches.rotation_prior is not None:
        factor = _rotation_factor(matches.rotation_prior)

        def cost(pose: Pose) -> float:
            _, off = factor.errors(np.stack([np.eye(3), pose.rotation]))
            return _unexplained(pose, matches) + float(off[0]) ** 2

        return [min(competing, key=cost)]
    return _likely_without_attitude(competing, matches)


def _likely_without_attitude(poses: list[Pose], matches: _Matches) -> list[Pose]:
    """Poses by cost, each refined first; none if another is nearly as good as the first."""
    ranked: list[tuple[float, Pose]] = []
    for start in poses:
        pose: Pose | None = start
        for limit in (16.0, 9.0):
            if pose is not None:
                pose = _adjusted(pose, matches, limit)
        if pose is not None:
            ranked.append((_unexplained(pose, matches), pose))
    if not ranked:
        return []
    ranked.sort(key=lambda c: c[0])
    cost, pose = ranked[0]
    others = [
        (other, competitor)
        for other, competitor in ranked[1:]
        if angle_between(competitor.rotation, pose.rotation) > np.radians(1.5)
        or float(competitor.translation @ pose.translation) < 0.95
    ]
    if any(other < MIN_COST_RATIO * cost + 30.0 for other, _ in others):
        return []
    plausible = PLAUSIBLE_COST * len(matches.xa)
    return [pose, *(competitor for other, competitor in others if other < plausible)]


def _rotation_factor(rotation_prior: Array) -> RelativeRotationFactor:
    """Factor between camera 1, which is a, and camera 0."""
    return RelativeRotationFactor.with_typical_errors(
        np.array([1]), np.array([0]), rotation_prior[None]
    )


def _unexplained(pose: Pose, matches: _Matches) -> float:
    """Sum of squared errors of all matches in both views, truncated at the outlier threshold."""
    return float(np.minimum(_squared_errors(pose, matches), 2 * GAMMA).sum())


def _squared_errors(pose: Pose, matches: _Matches) -> Array:
    """Squared errors (N,) of matches in both views, of the nearest point or of one at infinity.

    Noise puts half of the points that are too far for a parallax behind the cameras. Were they
    outliers, a motion that gives them a parallax by a wrong rotation would win over the true one.
    """
    points, _ = matches.triangulated(pose)
    in_b = pose.apply(points)
    near, behind = np.zeros(len(points)), (points[:, 2] <= 0) | (in_b[:, 2] <= 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        for p, seen, white in (
            (points, matches.xa, matches.whitening_a), (in_b, matches.xb, matches.whitening_b)
        ):  # fmt: skip
            near += _squared(p, seen, white)
    far_in_b = np.c_[matches.xa, np.ones(len(points))] @ pose.rotation.T
    # the best ray lies between the two that are seen, half of the error in each image
    far = 0.5 * _squared(far_in_b, matches.xb, matches.whitening_b)
    return np.fmin(np.where(behind, np.inf, near), np.where(far_in_b[:, 2] > 0, far, np.inf))


def _squared(points: Array, seen: Array, whitening: Array) -> Array:
    error = np.matmul(whitening, (points[:, :2] / points[:, 2:] - seen)[..., None])[..., 0]
    out: Array = (error * error).sum(1)
    return out


def _adjusted(pose: Pose, matches: _Matches, limit: float) -> Pose | None:
    """Pose with a unit baseline, bundle-adjusted on its inliers and on the prior."""
    points, _ = matches.triangulated(pose)
    ok = matches.consistent(points, pose, limit)
    n = int(np.count_nonzero(ok))
    if n < MIN_POINTS // 2:
        return None
    prior = matches.rotation_prior
    bundle = Bundle(
        [pose, Pose.identity()], 1, points[ok],
        np.repeat(np.array([0, 1]), n), np.tile(np.arange(n), 2),
        np.r_[matches.xb[ok], matches.xa[ok]],
        np.r_[matches.whitening_b[ok], matches.whitening_a[ok]],
        () if prior is None else (_rotation_factor(prior),),
    )  # fmt: skip
    adjusted = adjust(bundle, 12)
    scale = 1.0 / max(float(np.linalg.norm(adjusted.poses[0].translation)), 1e-12)
    return Pose(adjusted.poses[0].rotation, adjusted.poses[0].translation * scale)


def _refined(pose: Pose, matches: _Matches, min_parallax_rad: float) -> tuple[Pose, Bools] | None:
    """Pose, and the mask of inliers."""
    for limit in (16.0, 5.991):
        adjusted = _adjusted(pose, matches, limit)
        if adjusted is None:
            return None
        pose = adjusted
    points, cosine = matches.triangulated(pose)
    ok = matches.consistent(points, pose, GAMMA)
    if ok.sum() < MIN_POINTS or ok.sum() < 0.5 * len(ok):
        return None
    if matches.rotation_prior is not None:
        # wrong matches may agree on a turn, which gives what is far a parallax
        _, measured = matches.triangulated(Pose(matches.rotation_prior, pose.translation))
        cosine = np.maximum(cosine, measured)
    parallax = float(np.arccos(np.clip(np.quantile(cosine[ok], 0.3), -1, 1)))
    if parallax < min_parallax_rad or not _direction_certain(pose, matches, ok):
        return None
    return pose, ok


def _geometry(pose: Pose, matches: _Matches, shown_rad: float) -> TwoViewGeometry:
    """The geometry of a pose, of the matches that agree and have more parallax than `shown_rad`."""
    points, cosine = matches.triangulated(pose)
    shown = matches.consistent(points, pose, GAMMA) & (cosine < np.cos(shown_rad))
    return TwoViewGeometry(pose, points[shown], matches.index_a[shown], matches.index_b[shown])


def _direction_certain(pose: Pose, matches: _Matches, ok: Bools) -> bool:
    """True if the direction of motion is known well enough for a map."""
    prior, prior_sigma_rad = matches.rotation_prior, None
    max_sigma_rad = float(MAX_FREE_DIRECTION_SIGMA_RAD)
    if prior is not None:
        if angle_between(prior, np.eye(3)) < float(TURNING_RAD):
            return True
        prior_sigma_rad = float(_rotation_factor(prior).sigma_rad[0])
        max_sigma_rad = float(MAX_DIRECTION_SIGMA_RAD)
    sigma_rad = direction_sigma_rad(
        pose, matches.xa[ok], matches.xb[ok], matches.whitening_a[ok], matches.whitening_b[ok],
        prior_sigma_rad,
    )  # fmt: skip
    return sigma_rad <= max_sigma_rad
