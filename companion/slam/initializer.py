"""The first two keyframes: motion and points from two images alone.

An essential matrix explains a scene with depth, a homography a plane (a survey seen from straight
above); the one that explains more is taken (after Mur-Artal et al., 2015). Their several solutions
are told apart by cheirality, and by the autopilot's rotation where there is one.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from companion.geometry import Array, Pose, angle_between
from companion.slam.bundle import Bundle, adjust
from companion.slam.features import Bools, Features, Ints
from companion.slam.triangulation import consistent, triangulate
from companion.slam.turns import Turns

MAX_PRIOR_DISAGREEMENT_RAD = np.radians(8.0)
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
    rotation_prior: Array | None,
    min_parallax_rad: float,
) -> TwoView | None:
    """Motion and points from matches `index_a`, `index_b`; None when it would not be certain."""
    if len(index_a) < MIN_POINTS:
        return None
    xa, xb = a.normalised[index_a], b.normalised[index_b]
    turned = _turned(xa, xb, focal_px, rotation_prior)
    if np.mean(turned) > MAX_TURNED_SHARE:
        return None
    candidates: list[tuple[Pose, bool]] = []
    essential, homography = _models(xa * focal_px, xb * focal_px, focal_px, seed)
    planar = False
    if homography is not None and essential is not None:
        score_e = _score_essential(essential, xa, xb, focal_px)
        score_h = _score_homography(homography, xa, xb, focal_px)
        planar = score_h > 0.45 * (score_h + score_e)
    if essential is not None:
        r1, r2, t = cv2.decomposeEssentialMat(essential)
        direction = np.asarray(t, np.float64).ravel()
        rotations = (np.asarray(r1, np.float64), np.asarray(r2, np.float64))
        candidates += [(Pose(r, s * direction), False) for r in rotations for s in (1.0, -1.0)]
    if homography is not None and (planar or essential is None or rotation_prior is None):
        _, turns, shifts, _ = cv2.decomposeHomographyMat(homography, np.eye(3))
        for r, t in zip(turns, shifts, strict=True):
            norm = float(np.linalg.norm(t))
            if norm > 1e-6 and np.linalg.det(r) > 0:
                unit = np.asarray(t, np.float64).ravel() / norm
                candidates.append((Pose(np.asarray(r, np.float64), unit), True))
    if rotation_prior is not None:
        candidates += [(c, False) for c in _with_known_rotation(rotation_prior, xa, xb)]
        candidates = [
            c for c in candidates
            if angle_between(c[0].rotation, rotation_prior) < MAX_PRIOR_DISAGREEMENT_RAD
        ]  # fmt: skip
    best = _best(candidates, a, b, index_a, index_b, rotation_prior is not None)
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


def _models(pa: Array, pb: Array, focal_px: float, seed: int) -> tuple[Array | None, Array | None]:
    params = cv2.UsacParams()
    params.randomGeneratorState = seed
    params.confidence = 0.999
    params.maxIterations = 500
    params.threshold = 1.5
    params.score = cv2.SCORE_METHOD_MAGSAC
    params.sampler = cv2.SAMPLING_UNIFORM
    k = np.diag([focal_px, focal_px, 1.0])
    zero = np.zeros(5)
    found_e, _ = cv2.findEssentialMat(pa, pb, k, k, zero, zero, params)
    found_h, _ = cv2.findHomography(pa, pb, params)
    essential = homography = None
    if found_e is not None and found_e.shape == (3, 3):
        essential = np.asarray(found_e, np.float64)
    if found_h is not None:
        homography = (
            np.diag([1 / focal_px, 1 / focal_px, 1.0]) @ np.asarray(found_h, np.float64) @ k
        )
    return essential, homography


def _score_essential(e: Array, xa: Array, xb: Array, focal_px: float) -> float:
    ha, hb = np.c_[xa, np.ones(len(xa))], np.c_[xb, np.ones(len(xb))]
    score = 0.0
    for m, p, q in ((e, ha, hb), (e.T, hb, ha)):
        line = p @ m.T
        error = (line * q).sum(1) / np.maximum(np.linalg.norm(line[:, :2], axis=1), 1e-12)
        chi2 = (error * focal_px / 1.2) ** 2
        score += float(np.where(chi2 < 3.841, GAMMA - chi2, 0.0).sum())
    return score


def _score_homography(h: Array, xa: Array, xb: Array, focal_px: float) -> float:
    score = 0.0
    try:
        inverse = np.linalg.inv(h)
    except np.linalg.LinAlgError:
        return 0.0
    for m, p, q in ((h, xa, xb), (inverse, xb, xa)):
        moved = np.c_[p, np.ones(len(p))] @ m.T
        z = np.where(np.abs(moved[:, 2]) < 1e-9, 1e-9, moved[:, 2])
        error = (moved[:, :2] / z[:, None] - q) * focal_px / 1.2
        chi2 = (error * error).sum(1)
        score += float(np.where(chi2 < GAMMA, GAMMA - chi2, 0.0).sum())
    return score


def _with_known_rotation(rotation: Array, xa: Array, xb: Array) -> list[Pose]:
    """Both signs of the translation that, with this rotation, fits most rays."""
    rays_a = np.c_[xa, np.ones(len(xa))] @ rotation.T
    normals = np.cross(rays_a, np.c_[xb, np.ones(len(xb))])
    length = np.linalg.norm(normals, axis=1)
    weight = np.ones(len(normals))
    t = np.array([0.0, 0.0, 1.0])
    for _ in range(10):  # iteratively reweighted: robust to wrong matches
        scatter = (normals * weight[:, None]).T @ normals
        t = np.linalg.eigh(scatter)[1][:, 0]
        error = np.abs(normals @ t)
        scale = max(float(np.median(error)), 1e-6)
        weight = 1.0 / (1.0 + (error / (2.0 * scale)) ** 2) ** 2
    if float(np.median(length)) < 1e-5:
        return []
    return [Pose(rotation, t), Pose(rotation, -t)]


def _best(
    candidates: list[tuple[Pose, bool]],
    a: Features, b: Features, index_a: Ints, index_b: Ints, with_prior: bool,
) -> Pose | None:  # fmt: skip
    scored = []
    for pose, _ in candidates:
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
    if with_prior:
        return pose
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
