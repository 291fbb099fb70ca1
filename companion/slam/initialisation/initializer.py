"""The first two keyframes: motion and points from two images alone.

The motion is one of several that the images allow; which one is told by the points that it gives,
and by the autopilot's turn.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.geometry.transforms import Array, Pose, angle_between
from companion.slam.features.orb_features import Bools, Features, Ints
from companion.slam.features.triangulation import consistent, triangulate
from companion.slam.optimisation.bundle_adjustment import Bundle, adjust
from companion.slam.optimisation.motion_hypotheses import possible_motions
from companion.slam.optimisation.rotation_factor import Turns

MIN_POINTS = 60
GAMMA = 5.991
TURNED_PX, MAX_TURNED_SHARE = 2.0, 0.5
TOLD_TURN_RAD, TOLD_TURN_SHARE = np.radians(0.5), 0.1
"""What the autopilot's turn between two views may be off by, at least and as a share of it."""
RIVAL_SHARE = 0.6
"""Motions that fit fewer of the matches than this share of the best are no rivals to it."""
MIN_WORSE = 1.15
"""What another motion leaves unexplained must be so many times as much."""


@dataclass(frozen=True, slots=True, eq=False)
class TwoView:
    """Two views put together: `b_from_a` with a unit baseline, points (N, 3) in a."""

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
) -> TwoView | None:
    """Motion and points from matches `index_a`, `index_b`; None when it would not be certain.

    `attitudes` are `ned_from_camera` of a and b, where the autopilot told them.
    """
    if len(index_a) < MIN_POINTS:
        return None
    xa, xb = a.normalised[index_a], b.normalised[index_b]
    rotation_prior = None if attitudes is None else attitudes[1].T @ attitudes[0]
    turned = _turned(xa, xb, focal_px, rotation_prior)
    if np.mean(turned) > MAX_TURNED_SHARE:
        return None
    candidates, planar = possible_motions(xa, xb, focal_px, seed, attitudes)
    best = _best(candidates, a, b, index_a, index_b, rotation_prior)
    if best is None:
        return None
    found = _refined(best, a, b, index_a, index_b, rotation_prior, min_parallax_rad)
    if found is None:
        return None
    pose, points, agree, shown, parallax_rad = found
    # wrong matches speak for no turn either, and are known only now; untold turns have met rivals
    if rotation_prior is not None and np.sum(turned) > MAX_TURNED_SHARE * np.sum(turned | agree):
        return None
    return TwoView(pose, points[shown], index_a[shown], index_b[shown], parallax_rad, planar)


def _turned(xa: Array, xb: Array, focal_px: float, told: Array | None) -> Bools:
    """Which matches (N,) are explained by a rotation alone: a baseline would be made up for them.

    None where it is not the one that was `told`: a short way over a plane looks like a turn.
    """
    rays_a, rays_b = _unit_rays(xa), _unit_rays(xb)
    weight = np.ones(len(rays_a))
    error_px = np.zeros(len(rays_a))
    rotation = np.eye(3)
    for _ in range(15):  # robust Kabsch
        u, _, vt = np.linalg.svd((rays_b * weight[:, None]).T @ rays_a)
        rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        error_px = np.linalg.norm(rays_b - rays_a @ rotation.T, axis=1) * focal_px
        weight = 1.0 / (1.0 + (error_px / TURNED_PX) ** 2) ** 2
    if told is not None:
        off_rad = float(TOLD_TURN_RAD) + TOLD_TURN_SHARE * angle_between(told, np.eye(3))
        if angle_between(rotation, told) >= off_rad:
            return np.zeros(len(xa), bool)
    return np.asarray(error_px < TURNED_PX, bool)


def _unit_rays(normalised: Array) -> Array:
    rays = np.c_[normalised, np.ones(len(normalised))]
    out: Array = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return out


def _best(
    candidates: list[Pose], a: Features, b: Features, index_a: Ints, index_b: Ints,
    told: Array | None,
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
    if told is not None:
        turn = Turns.told(np.array([1]), np.array([0]), told[None])

        def cost(pose: Pose) -> float:
            _, off = turn.errors(np.stack([np.eye(3), pose.rotation]))
            return _unexplained(pose, a, b, index_a, index_b) + float(off[0]) ** 2

        return min((p for n, p in scored if n > RIVAL_SHARE * top), key=cost)
    return _most_likely([p for n, p in scored if n > RIVAL_SHARE * top], a, b, index_a, index_b)


def _most_likely(
    poses: list[Pose], a: Features, b: Features, index_a: Ints, index_b: Ints
) -> Pose | None:
    """The pose that explains most, each at its best; None where another does nearly as well."""
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
    for other, rival in best[1:]:
        different = (
            angle_between(rival.rotation, pose.rotation) > np.radians(1.5)
            or float(rival.translation @ pose.translation) < 0.95
        )
        if different and other < MIN_WORSE * cost + 30.0:
            return None
    return pose


def _unexplained(pose: Pose, a: Features, b: Features, index_a: Ints, index_b: Ints) -> float:
    """Squared errors of all matches in both views, each no more than an outlier's."""
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
    told: Array | None = None,
) -> Pose | None:  # fmt: skip
    """A pose, its baseline of length one, adjusted to the matches that agree with it.

    And to the turn that was `told`.
    """
    points, _ = triangulate(a.normalised[index_a], b.normalised[index_b], pose)
    ok = consistent(
        points, pose, a.normalised[index_a], b.normalised[index_b],
        a.whitening[index_a], b.whitening[index_b], limit,
    )  # fmt: skip
    ia, ib, pts = index_a[ok], index_b[ok], points[ok]
    n = len(ia)
    if n < MIN_POINTS // 2:
        return None
    turn = None if told is None else Turns.told(np.array([1]), np.array([0]), told[None])
    bundle = Bundle(
        [pose, Pose.identity()], 1, pts,
        np.repeat(np.array([0, 1]), n), np.tile(np.arange(n), 2),
        np.r_[b.normalised[ib], a.normalised[ia]], np.r_[b.whitening[ib], a.whitening[ia]],
        () if turn is None else (turn,),
    )  # fmt: skip
    adjusted = adjust(bundle, 12)
    scale = 1.0 / max(float(np.linalg.norm(adjusted.poses[0].translation)), 1e-12)
    return Pose(adjusted.poses[0].rotation, adjusted.poses[0].translation * scale)


def _refined(
    pose: Pose, a: Features, b: Features, index_a: Ints, index_b: Ints, told: Array | None,
    min_parallax_rad: float,
) -> tuple[Pose, Array, Bools, Bools, float] | None:  # fmt: skip
    """Pose, points (N, 3), which of them agree and which show their depth, parallax in rad."""
    for limit in (16.0, 5.991):
        adjusted = _adjusted(pose, a, b, index_a, index_b, limit, told)
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
