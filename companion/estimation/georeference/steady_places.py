"""Places of frames without what noise of their rotations makes of them.

A camera that is taken to be turned by a little is taken to have moved aside, too, so that it sees
what it saw: at 25 m a fiftieth of a degree is 9 mm, most of the noise of a frame's place.
Gyroscopes know turns from frame to frame better than that.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

from companion.estimation.georeference.tracked_places import Places
from companion.geometry.transforms import Array, skew

MAX_STEP_S = 0.5
"""Between two frames, for gyroscopes to say how one is turned against the other."""
LEAST_FRAMES = 30
"""For the noises to be told apart."""
OUTLIER = 5.0
"""Times the median: stamps that the clock of the link has shifted meanwhile."""
LEAST_WALK = 0.01
"""Variance of a turn by gyroscopes from frame to frame, at least, of that of a frame's rotation."""


def steadied(
    places: Places, turned: Array, rates: Array, gaps: NDArray[np.int64], mount: Array
) -> Places:
    """Frames with steadier places.

    `turned` (N, 3, 3) are rotations of the body by gyroscopes at the frames, comparable where
    `gaps` (N,) are the same and none is negative; `mount` (3, 3) is `body_from_camera`.
    """
    n, rotations = len(gaps), places.rotations
    if n < LEAST_FRAMES:
        return places
    dt_s = np.diff(places.t_ns) * 1e-9
    known = (gaps[1:] == gaps[:-1]) & (gaps[:-1] >= 0) & (dt_s < MAX_STEP_S)
    by_gyro = mount.T @ turned[:-1].transpose(0, 2, 1) @ turned[1:] @ mount
    seen = rotations[:-1].transpose(0, 2, 1) @ rotations[1:]
    # how much each frame is turned too far against the one before, axes of the map
    errors = np.einsum("nij,nj->ni", rotations[1:], _vectors(by_gyro.transpose(0, 2, 1) @ seen))
    if np.count_nonzero(known) < LEAST_FRAMES:
        return places
    changes = np.diff(np.einsum("nij,nj->ni", rotations, rates @ mount), axis=0)
    # by a delay of the stamps, a bias, and a mount that is a little off
    columns = np.concatenate([
        changes[..., None], rotations[1:] @ mount.T * dt_s[:, None, None],
        rotations[1:] @ skew(_vectors(by_gyro)),
    ], axis=2)  # fmt: skip
    errors = _without(errors, columns, known)
    noise = _noise(places.places, rotations, errors, known)
    if noise is None:
        return places
    share, coupling = noise
    angles = np.concatenate([np.zeros((1, 3)), np.cumsum(errors, axis=0)])
    band = np.zeros((2, n))
    band[0, 1:] = -1.0 / share
    band[1] = 1.0
    band[1, 1:] += 1.0 / share
    band[1, :-1] += 1.0 / share
    jitter = angles - solveh_banded(band, angles, check_finite=False)
    in_camera = np.einsum("nji,nj->ni", rotations, jitter)
    moved = np.einsum("nij,nj->ni", rotations, in_camera @ coupling)
    return places._replace(places=places.places - moved)


def _without(errors: Array, columns: Array, known: NDArray[np.bool_]) -> Array:
    """Errors (N, 3) without what follows columns (N, 3, M).

    Nothing where they are not known, or far beyond others.
    """
    left, n = errors, columns.shape[2]
    for _ in range(2):
        found, *_ = np.linalg.lstsq(
            columns[known].reshape(-1, n), errors[known].ravel(), rcond=None
        )
        left = errors - columns @ found
        size = np.linalg.norm(left, axis=1)
        known = known & (size < OUTLIER * float(np.median(size[known])))
    return np.where(known[:, None], left, 0.0)


def _noise(
    where: Array, rotations: Array, errors: Array, known: NDArray[np.bool_]
) -> tuple[float, Array] | None:
    """Variance of gyroscopes by that of rotations; change of place (3, 3) by turn, camera axes.

    A rotation's noise is in two successive errors, with opposite signs, that of gyroscopes in one.
    None where there is none to be seen.
    """
    pairs = known[1:] & known[:-1]
    first, second = errors[:-1][pairs], errors[1:][pairs]
    variance = -float((first * second).mean())
    if len(first) < LEAST_FRAMES or variance <= 0.0:
        return None
    walk = float((first**2 + second**2).mean()) / 2.0 - 2.0 * variance
    to_camera = rotations[1:-1][pairs].transpose(0, 2, 1)
    turns = (to_camera @ (second - first)[..., None])[..., 0]
    moves = (to_camera @ (where[2:] - 2.0 * where[1:-1] + where[:-2])[pairs][..., None])[..., 0]
    coupling, *_ = np.linalg.lstsq(turns, moves, rcond=None)
    return max(walk / variance, LEAST_WALK), np.asarray(coupling, np.float64)


def _vectors(rotations: Array) -> Array:
    """Rotation vectors (N, 3) of small rotations (N, 3, 3)."""
    skews = 0.5 * (rotations - rotations.transpose(0, 2, 1))
    return np.stack([skews[:, 2, 1], skews[:, 0, 2], skews[:, 1, 0]], 1)
