"""Relative pose with known gravity: the three-point solver (Fraundorfer et al., ECCV 2010).

The remaining rotation is one about the vertical; three correspondences give a quartic in the
tangent of half its angle. Gravity generates the hypotheses and does not constrain the result:
attitudes are less accurate than images.
"""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Array, Pose, rotation_from_vector, skew
from companion.slam.features.orb_features import Bools, Ints
from companion.slam.optimisation.upright_pose import rotations_about_z

N_SAMPLES = 120
N_FIRST, N_KEPT = 100, 8
"""Matches that all hypotheses are scored on, and hypotheses that are then refined."""
ROBUST_SCALES = (12.0, 8.0, 6.0, 4.0, 3.0, 2.0, 1.5, 1.0, 1.0)
"""Annealed scales of the robust weights, times the error threshold: initially they allow for tilt
errors."""
TILT_RAD = np.radians(3.0)
"""Tilt error that costs as much as one outlier: over a plane two motions explain all matches."""
MIN_PARALLAX_RATIO = 0.1
"""Ratio of matches that must show more than a rotation."""
NEARLY_REAL_RAD = 0.005
DAMPING = 1e-6
COARSE_FACTOR = 12.0
EPSILON = 1e-9
"""Numerical zero for unit rays."""
REFERENCE_ANGLE_RAD = 1.0
"""Reference of the half angle: half a turn from it has no tangent. Zero is no option, since half a
turn from there is always a root over level ground and in a vertical climb."""
FIFTHS = 2.0 * np.pi * np.arange(5) / 5.0


def upright_motion(
    normalised_a: Array, normalised_b: Array, level_from_a: Array, level_from_b: Array,
    max_error: float, seed: int,
) -> tuple[Pose, Bools] | None:  # fmt: skip
    """`b_from_a` with a unit baseline of most inliers among N matches, and the inlier mask.

    `normalised_a` and `normalised_b` are (N, 2); each `level_from` (3, 3) rotates camera rays to a
    frame with z down and any heading. `max_error` is the epipolar distance of an inlier, in
    normalised coordinates. None where no triple gives a translation, or where rotation alone
    explains nearly all matches.
    """
    n = len(normalised_a)
    if n < 3:
        return None
    a, b = np.c_[normalised_a, np.ones(n)], np.c_[normalised_b, np.ones(n)]
    rng = np.random.default_rng(seed)
    triples = rng.integers(n, size=(N_SAMPLES, 3))
    triples = triples[(triples != np.roll(triples, 1, 1)).all(1)]
    rotations, translations = three_point_motions(
        (a @ level_from_a.T)[triples], (b @ level_from_b.T)[triples]
    )
    if not len(rotations):
        return None
    rotations, translations = level_from_b.T @ rotations @ level_from_a, translations @ level_from_b
    some = rng.permutation(n)[:N_FIRST]
    first, _, _ = _scored(rotations, translations, a[some], b[some], COARSE_FACTOR * max_error)
    kept = np.argsort(first, kind="stable")[:N_KEPT]
    rotations, translations = _refined_motions(rotations[kept], translations[kept], a, b, max_error)
    cost, translations, agree = _scored(rotations, translations, a, b, max_error)
    tilt = np.linalg.norm(rotations @ level_from_a[2] - level_from_b[2], axis=1)
    best = int((cost + (tilt / TILT_RAD) ** 2).argmin())
    pose, agrees = Pose(rotations[best], translations[best]), agree[best]
    moved = b[agrees] - _seen(a[agrees] @ pose.rotation.T)
    if np.count_nonzero(np.linalg.norm(moved, axis=1) > 2.0 * max_error) < MIN_PARALLAX_RATIO * n:
        return None
    return pose, agrees


def three_point_motions(rays_a: Array, rays_b: Array) -> tuple[Array, Array]:
    """Rotations (M, 3, 3) about z and unit translations (M, 3), of either sign, of S triples.

    Rays and their matches are (S, 3, 3). The normals of their epipolar planes, rotated a x b, are
    perpendicular to the translation, so that their determinant vanishes: a trigonometric polynomial
    of degree two in the angle, determined by five samples. Up to four solutions per triple; none
    where rotation alone explains all three, or where they are coplanar with the translation.
    """
    rays_a = rays_a / np.linalg.norm(rays_a, axis=2, keepdims=True)
    rays_b = rays_b / np.linalg.norm(rays_b, axis=2, keepdims=True)
    angle = REFERENCE_ANGLE_RAD + FIFTHS
    normals = _normals(rays_a[:, None], rays_b[:, None], np.cos(angle), np.sin(angle))
    value = (normals[..., 0, :] * np.cross(normals[..., 1, :], normals[..., 2, :])).sum(-1)
    mean = value.mean(1)
    c1, s1 = 0.4 * value @ np.cos(FIFTHS), 0.4 * value @ np.sin(FIFTHS)
    c2, s2 = 0.4 * value @ np.cos(2 * FIFTHS), 0.4 * value @ np.sin(2 * FIFTHS)
    which, tangent = _real_roots(
        np.stack(
            [mean - c1 + c2, 2 * s1 - 4 * s2, 2 * mean - 6 * c2, 2 * s1 + 4 * s2, mean + c1 + c2], 1
        )
    )
    angle = REFERENCE_ANGLE_RAD + 2.0 * np.arctan(tangent)
    cosine, sine = np.cos(angle), np.sin(angle)
    normals = _normals(rays_a[which], rays_b[which], cosine, sine)
    across = np.cross(normals, np.roll(normals, 1, axis=1))
    size = np.linalg.norm(across, axis=2)
    longest = size.argmax(1)
    each = np.arange(len(which))
    translations, size = across[each, longest], size[each, longest]
    good = size > EPSILON
    return rotations_about_z(cosine, sine)[good], translations[good] / size[good, None]


def _normals(rays_a: Array, rays_b: Array, cosine: Array, sine: Array) -> Array:
    """Normals of the planes of rays (..., 3, 3), the first rotated about z by each angle (...)."""
    c, s = cosine[..., None], sine[..., None]
    x, y, z = rays_a[..., 0], rays_a[..., 1], rays_a[..., 2]
    x, y = c * x - s * y, s * x + c * y
    u, v, w = rays_b[..., 0], rays_b[..., 1], rays_b[..., 2]
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], -1)


def _real_roots(quartics: Array) -> tuple[Ints, Array]:
    """Indices of quartics (S, 5) in the tangent of half an angle, with their real roots.

    Roots that noise made slightly complex count as real.
    """
    size = np.abs(quartics).max(1)
    some = np.flatnonzero((size > 0.0) & (np.abs(quartics[:, 0]) > EPSILON * size))
    companion = np.zeros((len(some), 4, 4))
    companion[:, 0] = -quartics[some, 1:] / quartics[some, :1]
    companion[:, 1, 0] = companion[:, 2, 1] = companion[:, 3, 2] = 1.0
    roots = np.linalg.eigvals(companion)
    real = np.abs(roots.imag) < 0.5 * NEARLY_REAL_RAD * (1.0 + roots.real**2)
    row, column = np.nonzero(real)
    return np.asarray(some[row], np.int64), np.asarray(roots.real[row, column], np.float64)


def _scored(
    rotations: Array, translations: Array, a: Array, b: Array, max_error: float
) -> tuple[Array, Array, Bools]:
    """Cost (K,), signed translation (K, 3) and inlier mask (K, N) of K motions of either sign.

    The cost of a match is its squared Sampson distance, truncated to 1 at `max_error` and for
    points behind the cameras; distant points do not vote on the sign.
    """
    error, steep, along_a, turned_b = _products(rotations, translations, a, b)
    each = error**2 / np.maximum(steep * max_error**2, EPSILON**2)
    along_b, size_a, size_b = translations @ b.T, (a**2).sum(1), (b**2).sum(1)
    near = size_a * size_b - turned_b**2 > max_error**2
    # depths, each times the same positive number
    in_b = along_b * size_a - along_a * turned_b
    in_a = along_b * turned_b - along_a * size_b
    behind = near & ~((in_a > 0.0) & (in_b > 0.0))
    ahead = near & ~((in_a < 0.0) & (in_b < 0.0))
    backwards = behind.sum(1) > ahead.sum(1)
    agree = (each < 1.0) & ~np.where(backwards[:, None], ahead, behind)
    sign = np.where(backwards, -1.0, 1.0)
    return np.where(agree, each, 1.0).sum(1), translations * sign[:, None], agree


def _products(
    rotations: Array, translations: Array, a: Array, b: Array
) -> tuple[Array, Array, Array, Array]:
    """Epipolar quantities of K motions and N matches, all (K, N).

    The epipolar error, its squared gradient by both positions, and the products of rotated a with
    the translation and with b.
    """
    essential = skew(translations) @ rotations
    pairs = _pairs(a, b)
    error = essential.reshape(-1, 9) @ pairs
    steep = (essential[:, 0] @ a.T) ** 2 + (essential[:, 1] @ a.T) ** 2
    steep += (essential[:, :, 0] @ b.T) ** 2 + (essential[:, :, 1] @ b.T) ** 2
    along_a = (translations[:, None] @ rotations)[:, 0] @ a.T
    return error, steep, along_a, rotations.reshape(-1, 9) @ pairs


def _pairs(a: Array, b: Array) -> Array:
    """Products (9, N) of the components of b with those of a, for bilinear forms."""
    return (b[:, :, None] * a[:, None]).reshape(-1, 9).T


def _refined_motions(
    rotations: Array, translations: Array, a: Array, b: Array, max_error: float
) -> tuple[Array, Array]:
    """Refine all five degrees of freedom of K motions, not constrained to the measured vertical.

    Gauss-Newton with Tukey weights.
    """
    pairs = _pairs(a, b)
    for robust_scale in ROBUST_SCALES:
        error, steep, along_a, turned_b = _products(rotations, translations, a, b)
        steep = np.sqrt(np.maximum(steep, EPSILON**2))
        error /= steep
        side = np.linalg.svd(translations[:, None])[2][:, 1:]
        by_rotation = b.T * along_a[:, None] - translations[..., None] * turned_b[:, None]
        by_translation = (skew(side) @ rotations[:, None]).reshape(-1, 2, 9) @ pairs
        jacobian = np.concatenate([by_rotation, by_translation], 1) / steep[:, None]
        weight = np.maximum(1.0 - (error / (robust_scale * max_error)) ** 2, 0.0) ** 2
        weighted = jacobian * weight[:, None]
        system = weighted @ jacobian.transpose(0, 2, 1)
        system += (DAMPING * np.trace(system, axis1=1, axis2=2) + EPSILON)[:, None, None] * np.eye(
            5
        )
        step = -np.linalg.solve(system, weighted @ error[..., None])[..., 0]
        rotations = np.stack([rotation_from_vector(s[:3]) for s in step]) @ rotations
        translations = translations + (step[:, None, 3:] @ side)[:, 0]
        translations = translations / np.linalg.norm(translations, axis=1, keepdims=True)
    return rotations, translations


def _seen(points: Array) -> Array:
    out: Array = points / points[:, 2:]
    return out
