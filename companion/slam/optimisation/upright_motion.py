"""Relative pose where the vertical is known: three rays are enough (Fraundorfer et al., ECCV 2010).

What is left of the rotation is one about the vertical, and three rays with their matches leave a
quartic in the tangent of half its angle. The vertical finds hypotheses, it does not bind the
result: attitudes are wrong by more than images are.
"""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Array, Pose, rotation_from_vector, skew
from companion.slam.features.orb_features import Bools, Ints

N_SAMPLES = 120
N_FIRST, N_KEPT = 100, 8
"""All hypotheses are tried on so many of the matches, and so many of them improved."""
LOOSE = (12.0, 8.0, 6.0, 4.0, 3.0, 2.0, 1.5, 1.0, 1.0)
"""What tilts may be wrong by is allowed for at first: times the greatest error, as it improves."""
TILT_RAD = np.radians(3.0)
"""The vertical that is so much off speaks against a motion as a wrong match does: over a plane two
motions explain all."""
MIN_TELLING = 0.1
"""So large a share of the matches that agree has to show more than a turn."""
NEARLY_REAL_RAD = 0.005
DAMPING = 1e-6
FIRST = 12.0
LEAST = 1e-9
"""Of rays of length one: what is less is nought."""
FROM_RAD = 1.0
"""Where half angles are counted from: half a turn from there has no tangent, but half a turn from
none is always a root over level ground, and where the camera climbs straight up."""
FIFTHS = 2.0 * np.pi * np.arange(5) / 5.0


def upright_motion(
    normalised_a: Array, normalised_b: Array, level_from_a: Array, level_from_b: Array,
    max_error: float, seed: int,
) -> tuple[Pose, Bools] | None:  # fmt: skip
    """`b_from_a`, its baseline of length one, that fits most of N matches, and which these are.

    `normalised_a` and `normalised_b` are (N, 2); each `level_from` (3, 3) turns a camera's rays to
    a frame whose z is down, of any heading. `max_error` is that of a match from its epipolar line,
    in normalised coordinates. None where no three matches tell a way, or a turn alone explains
    nearly all.
    """
    n = len(normalised_a)
    if n < 3:
        return None
    a, b = np.c_[normalised_a, np.ones(n)], np.c_[normalised_b, np.ones(n)]
    rng = np.random.default_rng(seed)
    triples = rng.integers(n, size=(N_SAMPLES, 3))
    triples = triples[(triples != np.roll(triples, 1, 1)).all(1)]
    turns, ways = motions_of_three((a @ level_from_a.T)[triples], (b @ level_from_b.T)[triples])
    if not len(turns):
        return None
    turns, ways = level_from_b.T @ turns @ level_from_a, ways @ level_from_b
    some = rng.permutation(n)[:N_FIRST]
    first, _, _ = _judged(turns, ways, a[some], b[some], FIRST * max_error)
    kept = np.argsort(first, kind="stable")[:N_KEPT]
    turns, ways = _improved(turns[kept], ways[kept], a, b, max_error)
    cost, ways, agree = _judged(turns, ways, a, b, max_error)
    tilt = np.linalg.norm(turns @ level_from_a[2] - level_from_b[2], axis=1)
    best = int((cost + (tilt / TILT_RAD) ** 2).argmin())
    pose, agrees = Pose(turns[best], ways[best]), agree[best]
    moved = b[agrees] - _seen(a[agrees] @ pose.rotation.T)
    if np.count_nonzero(np.linalg.norm(moved, axis=1) > 2.0 * max_error) < MIN_TELLING * n:
        return None
    return pose, agrees


def motions_of_three(rays_a: Array, rays_b: Array) -> tuple[Array, Array]:
    """Rotations (M, 3, 3) about z and unit translations (M, 3), of either sign, of S triples.

    Rays and their matches are (S, 3, 3). Their epipolar planes' normals, turned a x b, are all
    square to the translation, so that their determinant vanishes; it is a sum of sines and cosines
    of the angle and of twice the angle, which five angles tell. Up to four for a triple; none where
    all three are explained by a turn alone, or lie in one plane with the translation.
    """
    rays_a = rays_a / np.linalg.norm(rays_a, axis=2, keepdims=True)
    rays_b = rays_b / np.linalg.norm(rays_b, axis=2, keepdims=True)
    angle = FROM_RAD + FIFTHS
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
    angle = FROM_RAD + 2.0 * np.arctan(tangent)
    cosine, sine = np.cos(angle), np.sin(angle)
    normals = _normals(rays_a[which], rays_b[which], cosine, sine)
    across = np.cross(normals, np.roll(normals, 1, axis=1))
    size = np.linalg.norm(across, axis=2)
    longest = size.argmax(1)
    each = np.arange(len(which))
    ways, size = across[each, longest], size[each, longest]
    good = size > LEAST
    rotations = np.zeros((len(which), 3, 3))
    rotations[:, 0, 0] = rotations[:, 1, 1] = cosine
    rotations[:, 0, 1], rotations[:, 1, 0] = -sine, sine
    rotations[:, 2, 2] = 1.0
    return rotations[good], ways[good] / size[good, None]


def _normals(rays_a: Array, rays_b: Array, cosine: Array, sine: Array) -> Array:
    """Of the planes of rays (..., 3, 3), the first turned about z by each angle (...)."""
    c, s = cosine[..., None], sine[..., None]
    x, y, z = rays_a[..., 0], rays_a[..., 1], rays_a[..., 2]
    x, y = c * x - s * y, s * x + c * y
    u, v, w = rays_b[..., 0], rays_b[..., 1], rays_b[..., 2]
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], -1)


def _real_roots(quartics: Array) -> tuple[Ints, Array]:
    """Which of quartics (S, 5) in the tangent of half an angle have which angles as roots.

    Those that noise made all but real are taken for real.
    """
    size = np.abs(quartics).max(1)
    some = np.flatnonzero((size > 0.0) & (np.abs(quartics[:, 0]) > LEAST * size))
    companion = np.zeros((len(some), 4, 4))
    companion[:, 0] = -quartics[some, 1:] / quartics[some, :1]
    companion[:, 1, 0] = companion[:, 2, 1] = companion[:, 3, 2] = 1.0
    roots = np.linalg.eigvals(companion)
    real = np.abs(roots.imag) < 0.5 * NEARLY_REAL_RAD * (1.0 + roots.real**2)
    row, column = np.nonzero(real)
    return np.asarray(some[row], np.int64), np.asarray(roots.real[row, column], np.float64)


def _judged(
    turns: Array, ways: Array, a: Array, b: Array, max_error: float
) -> tuple[Array, Array, Bools]:
    """Cost (K,), translation (K, 3) and which matches agree (K, N), of K motions of either sign.

    The cost of a match is its squared distance from the epipolar line (after Sampson), 1 where that
    is `max_error` or where it lies behind the cameras; far away nobody can tell before from behind.
    """
    error, steep, along_a, turned_b = _products(turns, ways, a, b)
    each = error**2 / np.maximum(steep * max_error**2, LEAST**2)
    along_b, size_a, size_b = ways @ b.T, (a**2).sum(1), (b**2).sum(1)
    near = size_a * size_b - turned_b**2 > max_error**2
    # depths, each times the same positive number
    in_b = along_b * size_a - along_a * turned_b
    in_a = along_b * turned_b - along_a * size_b
    behind = near & ~((in_a > 0.0) & (in_b > 0.0))
    ahead = near & ~((in_a < 0.0) & (in_b < 0.0))
    backwards = behind.sum(1) > ahead.sum(1)
    agree = (each < 1.0) & ~np.where(backwards[:, None], ahead, behind)
    sign = np.where(backwards, -1.0, 1.0)
    return np.where(agree, each, 1.0).sum(1), ways * sign[:, None], agree


def _products(
    turns: Array, ways: Array, a: Array, b: Array
) -> tuple[Array, Array, Array, Array]:
    """What K motions make of N matches, all (K, N).

    The epipolar error, what it grows by with both positions (squared), and the products of a turned
    with the translation and with b.
    """
    essential = skew(ways) @ turns
    pairs = _pairs(a, b)
    error = essential.reshape(-1, 9) @ pairs
    steep = (essential[:, 0] @ a.T) ** 2 + (essential[:, 1] @ a.T) ** 2
    steep += (essential[:, :, 0] @ b.T) ** 2 + (essential[:, :, 1] @ b.T) ** 2
    along_a = (ways[:, None] @ turns)[:, 0] @ a.T
    return error, steep, along_a, turns.reshape(-1, 9) @ pairs


def _pairs(a: Array, b: Array) -> Array:
    """Products (9, N) of the components of b with those of a: what takes them is bilinear."""
    return (b[:, :, None] * a[:, None]).reshape(-1, 9).T


def _improved(
    turns: Array, ways: Array, a: Array, b: Array, max_error: float
) -> tuple[Array, Array]:
    """All five degrees of freedom of K motions made to fit, whatever the vertical was told to be.

    Gauss-Newton, by weights (Tukey's) that leave out what does not agree.
    """
    pairs = _pairs(a, b)
    for loose in LOOSE:
        error, steep, along_a, turned_b = _products(turns, ways, a, b)
        steep = np.sqrt(np.maximum(steep, LEAST**2))
        error /= steep
        side = np.linalg.svd(ways[:, None])[2][:, 1:]
        by_turn = b.T * along_a[:, None] - ways[..., None] * turned_b[:, None]
        by_way = (skew(side) @ turns[:, None]).reshape(-1, 2, 9) @ pairs
        jacobian = np.concatenate([by_turn, by_way], 1) / steep[:, None]
        weight = np.maximum(1.0 - (error / (loose * max_error)) ** 2, 0.0) ** 2
        weighted = jacobian * weight[:, None]
        system = weighted @ jacobian.transpose(0, 2, 1)
        system += (DAMPING * np.trace(system, axis1=1, axis2=2) + LEAST)[:, None, None] * np.eye(5)
        step = -np.linalg.solve(system, weighted @ error[..., None])[..., 0]
        turns = np.stack([rotation_from_vector(s[:3]) for s in step]) @ turns
        ways = ways + (step[:, None, 3:] @ side)[:, 0]
        ways = ways / np.linalg.norm(ways, axis=1, keepdims=True)
    return turns, ways


def _seen(points: Array) -> Array:
    out: Array = points / points[:, 2:]
    return out
