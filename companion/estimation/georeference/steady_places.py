"""Frames without what gyroscopes know to be errors of their rotations, and of places by these.

A camera that is taken to be turned by a little is taken to have moved aside, too, so that it sees
what it saw: at 25 m a fiftieth of a degree is 9 mm, most of the noise of a frame's place. A young
map of few points is turned by half a degree for seconds: then a motion aside is half a turn, and
gravity half an acceleration. From frame to frame gyroscopes know turns better; over longer, less
their bias, which the autopilot's level shows, they know them better than a map that bends so.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

from companion.estimation.georeference.tracked_places import Places
from companion.estimation.inertial.steady_level import (
    AUTOPILOT_S,
    BIAS_WALK_RAD_S2,
    SIGMA_AUTOPILOT_RAD,
    SIGMA_BIAS_RAD_S,
    SIGMA_DELAY_S,
)
from companion.estimation.inertial.turn_integral import rotations_from_vectors
from companion.geometry.transforms import Array, skew

MAX_STEP_S = 0.5
"""Between two frames, for gyroscopes to say how one is turned against the other."""
LEAST_FRAMES = 30
"""For the noises to be told apart."""
OUTLIER = 5.0
"""Times the median: corrections of the map, and stamps that the clock of the link has shifted. They
say nothing of noise."""
LEAST_WALK = 0.01
"""Variance of the walk from frame to frame, at least, of that of a frame's rotation."""
SIGMA_MOUNT_RAD = float(np.radians(1.0))
"""Of a mount that turns of the camera have corrected; without it, bends of a map look like it."""
DRIFT_RAD_S = BIAS_WALK_RAD_S2 * AUTOPILOT_S
"""Their bias walks by it until the autopilot's level shows that, per root of a second."""
NEAR_S, LEAST_SHARE, MOST_GAIN = 2.0, 0.1, 2.0
"""Frames about one that show how far away is what it sees; noise there, of the mean, from which on
they count; and how much further it may be than on the mean."""


class _Noise(NamedTuple):
    """Variances of a frame's rotation, and of the walk between two frames."""

    frame: float
    walk: float


def steadied(
    places: Places, turned: Array, rates: Array, gaps: NDArray[np.int64], mount: Array,
    density_rad_s: float,
) -> Places:  # fmt: skip
    """Frames with steadier places and rotations.

    `turned` (N, 3, 3) are rotations of the body by gyroscopes at the frames, comparable where
    `gaps` (N,) are the same and none is negative, with a noise density in rad/s per root of Hz;
    `mount` (3, 3) is `body_from_camera`.
    """
    dt_s, rotations = np.diff(places.t_ns) * 1e-9, places.rotations
    known = (gaps[1:] == gaps[:-1]) & (gaps[:-1] >= 0) & (dt_s < MAX_STEP_S)
    if np.count_nonzero(known) < LEAST_FRAMES:
        return places
    by_gyro = mount.T @ turned[:-1].transpose(0, 2, 1) @ turned[1:] @ mount
    changes = np.diff(np.einsum("nij,nj->ni", rotations, rates @ mount), axis=0)
    # by a bias, a delay of the stamps, and a mount that is a little off
    columns = known[:, None, None] * np.concatenate([
        rotations[1:] @ mount.T * dt_s[:, None, None], changes[..., None],
        rotations[1:] @ skew(_vectors(by_gyro)),
    ], axis=2)  # fmt: skip
    errors, by_autopilot = (
        known[:, None] * _turned_too_far(each, by_gyro, rotations)
        for each in (rotations, places.ned_from_camera)
    )
    aside = places.level[:2]  # an autopilot's heading swings
    information, right = _by_level(aside @ columns[:, :, :3], by_autopilot @ aside.T, dt_s)
    left, sound = errors, known
    for _ in range(2):
        spread = 1.5 * float(np.median(np.abs(left[sound])))
        rows, seen = columns[sound].reshape(-1, 7) / spread, errors[sound].ravel() / spread
        found = np.linalg.solve(information + rows.T @ rows, right + rows.T @ seen)
        left = errors - columns @ found
        size = np.linalg.norm(left, axis=1)
        sound = known & (size < OUTLIER * float(np.median(size[known])))
    noise = _noise(left, sound)
    if noise is None:
        return places
    by_gyroscopes = (density_rad_s**2 + DRIFT_RAD_S**2) * float(np.median(dt_s))
    angles = _summed(left)
    walked = min(by_gyroscopes / noise.walk, 1.0) * _walked(angles, noise)
    jitter = angles - walked
    moved = _moved(places, left, sound, jitter, round(NEAR_S / float(np.median(dt_s))))
    return places._replace(
        places=places.places - moved, rotations=rotations_from_vectors(-jitter) @ rotations
    )


def _turned_too_far(rotations: Array, by_gyro: Array, axes: Array) -> Array:
    """Turns (N - 1, 3) from frame to frame beyond those by gyroscopes, in axes (N, 3, 3)."""
    seen = rotations[:-1].transpose(0, 2, 1) @ rotations[1:]
    return np.asarray(
        np.einsum("nij,nj->ni", axes[1:], _vectors(by_gyro.transpose(0, 2, 1) @ seen)), np.float64
    )


def _by_level(by_bias: Array, errors: Array, dt_s: Array) -> tuple[Array, Array]:
    """Prior of bias, delay and mount: information (7, 7) and right side (7,).

    By errors (N, 2) of the autopilot's level against gyroscopes, which change `by_bias` (N, 2, 3).
    """
    lasting = max(float(dt_s.sum()) / (2.0 * AUTOPILOT_S), 1.0) / (len(dt_s) + 1)
    weight = lasting / SIGMA_AUTOPILOT_RAD**2
    rows, seen = _summed(by_bias).reshape(-1, 3), _summed(errors).ravel()
    information = np.diag(np.r_[
        np.full(3, SIGMA_BIAS_RAD_S), SIGMA_DELAY_S, np.full(3, SIGMA_MOUNT_RAD)
    ] ** -2)  # fmt: skip
    information[:3, :3] += weight * rows.T @ rows
    return information, np.r_[weight * rows.T @ seen, np.zeros(4)]


def _noise(errors: Array, sound: NDArray[np.bool_]) -> _Noise | None:
    """Noises by errors (N, 3) from frame to frame; None where there is none to be seen.

    A rotation's is in two successive errors, with opposite signs, that of a walk in one.
    """
    pairs = sound[1:] & sound[:-1]
    first, second = errors[:-1][pairs], errors[1:][pairs]
    variance = -float((first * second).mean())
    if len(first) < LEAST_FRAMES or variance <= 0.0:
        return None
    walk = float((first**2 + second**2).mean()) / 2.0 - 2.0 * variance
    return _Noise(variance, max(walk, LEAST_WALK * variance))


def _walked(angles: Array, noise: _Noise) -> Array:
    """The walk in angles (N, 3) of frames: that of gyroscopes and map together."""
    ratio = noise.frame / noise.walk
    band = np.zeros((2, len(angles)))
    band[0, 1:], band[1] = -ratio, 1.0
    band[1, 1:] += ratio
    band[1, :-1] += ratio
    return np.asarray(solveh_banded(band, angles, check_finite=False), np.float64)


def _moved(
    places: Places, errors: Array, sound: NDArray[np.bool_], jitter: Array, n_near: int
) -> Array:
    """Motion (N, 3) that frames are taken to have, as they are turned by `jitter` (N, 3)."""
    to_camera = places.rotations.transpose(0, 2, 1)
    bends = (sound[1:] & sound[:-1])[:, None] * np.diff(errors, axis=0)
    turns = np.einsum("nij,nj->ni", to_camera[1:-1], bends)
    moves = np.einsum("nij,nj->ni", to_camera[1:-1], np.diff(places.places, 2, axis=0))
    by_turn, *_ = np.linalg.lstsq(turns, moves * (turns != 0.0).any(1)[:, None], rcond=None)
    # as much of it as shows in the frames about each: the ground comes nearer, or goes away
    expected = turns @ by_turn
    window = np.ones(2 * min(n_near, (len(turns) - 1) // 2) + 1)
    squares = (expected**2).sum(1)
    least = LEAST_SHARE * float(squares.mean()) * len(window)
    seen = np.convolve((expected * moves).sum(1), window, "same") + least
    gain = np.clip(seen / (np.convolve(squares, window, "same") + least), 0.0, MOST_GAIN)
    aside = np.pad(gain, 1, mode="edge")[:, None] * (
        np.einsum("nij,nj->ni", to_camera, jitter) @ by_turn
    )
    return np.asarray(np.einsum("nij,nj->ni", places.rotations, aside), np.float64)


def _summed(steps: Array) -> Array:
    """Sums (N, ...) of steps (N - 1, ...) from frame to frame, about their mean."""
    sums = np.concatenate([np.zeros((1, *steps.shape[1:])), np.cumsum(steps, axis=0)])
    return np.asarray(sums - sums.mean(0), np.float64)


def _vectors(rotations: Array) -> Array:
    """Rotation vectors (N, 3) of small rotations (N, 3, 3)."""
    skews = 0.5 * (rotations - rotations.transpose(0, 2, 1))
    return np.stack([skews[:, 2, 1], skews[:, 0, 2], skews[:, 1, 0]], 1)
