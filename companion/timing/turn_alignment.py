"""When a log was recorded, by how the camera turned: two records of the same rotation, shifted.

The body turns as the camera on it does, but for a fixed rotation between them. Both are compared
at every shift; where that rotation is not known the best one is taken at each, which is the sum of
the singular values of their correlation (Kabsch 1976).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft
from scipy.ndimage import uniform_filter1d

from companion.geometry.transforms import Array

SMOOTH_S = 4.0
"""What changes more slowly is left aside: gyros drift, and translation looks like turning."""
LEAST_OVERLAP_S = 10.0
LEAST_SHARE = 0.5
APART_S = 1.0
"""Shifts nearer than this to the best one are part of its peak."""
LEAST_SCORE = 0.35
MOST_SECOND, MOST_UNEXPLAINED, BEST_UNEXPLAINED = 0.7, 0.35, 0.02
"""A shift is the only one if others agree so much less, or leave so much more unexplained."""
LEAST_TURN_RAD_S = 0.004
N_BLOCKS = 8
LEAST_BLOCK_S = 5.0
FINE_S = 0.002


@dataclass(frozen=True, slots=True, eq=False)
class TurnRecord:
    """Turns over time: `angle_rad` (N, 3) is summed up from the first of `t_s` (N,), ascending."""

    t_s: Array
    angle_rad: Array

    def rates(self, t_s: Array) -> Array:
        """Mean rates (M - 1, 3) between the times (M,)."""
        angle = np.stack([np.interp(t_s, self.t_s, a) for a in self.angle_rad.T], 1)
        out: Array = np.diff(angle, axis=0) / np.diff(t_s)[:, None]
        return out


@dataclass(frozen=True, slots=True)
class TimeAlignment:
    """How to shift a log: add `offset_s` to its times.

    `score` is how well the rotations agree, 1 being the best; `second` is the best score at a
    shift that is another one, `second_offset_s`.
    """

    offset_s: float
    sigma_s: float
    score: float
    second: float
    second_offset_s: float
    overlap_s: float
    turn_rad_s: float

    @property
    def why_not(self) -> str | None:
        """In words why it cannot be relied upon; None if it can."""
        if self.turn_rad_s < LEAST_TURN_RAD_S:
            return "the camera hardly turns"
        if self.score < LEAST_SCORE:
            return f"the rotations agree badly, {self.score:.2f} of 1"
        unexplained = max(1 - self.score**2, BEST_UNEXPLAINED) / (1 - min(self.second, 0.9999) ** 2)
        if self.second > MOST_SECOND * self.score and unexplained > MOST_UNEXPLAINED:
            return (
                f"{self.offset_s:.2f} s fits with {self.score:.2f}, but {self.second_offset_s:.2f} "
                f"s with {self.second:.2f}"
            )
        return None

    def __str__(self) -> str:
        return (
            f"{self.offset_s:+.3f} s, within {1000 * self.sigma_s:.0f} ms (one standard "
            f"deviation); rotations agree {self.score:.2f} of 1, at any other shift "
            f"{max(self.second, 0.0):.2f} at most"
        )


def align_turns(
    camera: TurnRecord, log: TurnRecord, step_s: float, log_from_camera: Array | None = None
) -> TimeAlignment | None:
    """The shift of the log that makes its rotation the camera's; None where both are too short.

    `step_s` is that of the camera's frames; `log_from_camera` (3, 3) the rotation between them
    where it is known.
    """
    grid = [np.arange(r.t_s[0], r.t_s[-1], step_s) for r in (camera, log)]
    if min(len(g) for g in grid) * step_s < LEAST_OVERLAP_S:
        return None
    turns, logged = (_high(r.rates(g), step_s) for r, g in zip((camera, log), grid, strict=True))
    if log_from_camera is not None:
        turns = turns @ log_from_camera.T
    scores, lags = _scores(turns, logged, step_s, log_from_camera is not None)
    best = int(np.argmax(scores))
    # a turn at camera time t is in the log at t - offset
    offset_s = float(grid[0][0] - grid[1][0] - lags[best] * step_s)
    away = np.abs(lags - lags[best]) * step_s > APART_S
    rival = int(np.argmax(np.where(away, scores, -np.inf)))
    fine_s, sigma_s, score = _refined(camera, log, offset_s, step_s, log_from_camera)
    first = max(camera.t_s[0], log.t_s[0] + fine_s)
    last = min(camera.t_s[-1], log.t_s[-1] + fine_s)
    return TimeAlignment(
        fine_s, sigma_s, score, float(scores[rival]) if away.any() else 0.0,
        float(grid[0][0] - grid[1][0] - lags[rival] * step_s), float(last - first),
        float(np.sqrt((turns**2).sum(1).mean())),
    )  # fmt: skip


def _high(rates: Array, step_s: float) -> Array:
    """Rates without what changes slowly, cut where they jump."""
    n = max(3, round(SMOOTH_S / step_s))
    high = rates - uniform_filter1d(rates, n, axis=0, mode="nearest")
    most = 6 * np.sqrt((high**2).mean(0)) + 1e-9
    out: Array = np.clip(high, -most, most)
    return out


def _scores(
    turns: Array, logged: Array, step_s: float, known: bool
) -> tuple[Array, NDArray[np.int64]]:
    """Scores and the steps by which the camera's record begins after the log's."""
    n, m = len(turns), len(logged)
    size = next_fast_len(n + m)
    spectra = rfft(turns, size, axis=0), rfft(logged, size, axis=0)
    product = irfft(spectra[1][:, :, None] * np.conj(spectra[0])[:, None, :], size, axis=0)
    least = max(round(LEAST_OVERLAP_S / step_s), round(LEAST_SHARE * min(n, m)))
    lags = np.arange(least - n, m - least + 1, dtype=np.int64)
    correlation = product[lags % size]
    energy = [np.concatenate([[0.0], np.cumsum((r**2).sum(1))]) for r in (turns, logged)]
    first, last = np.maximum(0, -lags), np.minimum(n, m - lags)
    of_turns = energy[0][last] - energy[0][first]
    of_log = energy[1][last + lags] - energy[1][first + lags]
    agreement = _agreement(correlation, known) / np.sqrt(of_turns * of_log + 1e-18)
    # where only what is calm overlaps, much agrees by chance
    share = np.maximum(of_turns / (energy[0][-1] + 1e-18), of_log / (energy[1][-1] + 1e-18))
    return np.asarray(agreement * np.sqrt(share), np.float64), lags


def _agreement(correlation: Array, known: bool) -> Array:
    if known:
        return np.asarray(np.trace(correlation, axis1=1, axis2=2), np.float64)
    u, s, vt = np.linalg.svd(correlation)
    s[:, 2] *= np.sign(np.linalg.det(u @ vt))
    out: Array = s.sum(1)
    return out


def _refined(
    camera: TurnRecord, log: TurnRecord, offset_s: float, step_s: float,
    log_from_camera: Array | None,
) -> tuple[float, float, float]:  # fmt: skip
    """The shift to fractions of a step, its standard deviation, and the score there."""
    inside = (camera.t_s >= log.t_s[0] + offset_s) & (camera.t_s <= log.t_s[-1] + offset_s)
    t_s = camera.t_s[inside]
    turns = _high(camera.rates(t_s), step_s)
    shifts = np.arange(-1.5 * step_s, 1.5 * step_s + FINE_S, FINE_S)
    moved = [_high(log.rates(t_s - offset_s - shift), step_s) for shift in shifts]
    best, score = _peak(turns, moved, shifts, log_from_camera)
    n = min(N_BLOCKS, int((t_s[-1] - t_s[0]) / LEAST_BLOCK_S))
    parts = np.array_split(np.arange(len(turns)), max(n, 1))
    rotation = log_from_camera
    if rotation is None:  # of one block alone it would be anybody's
        at = int(np.abs(shifts - best).argmin())
        u, _, vt = np.linalg.svd(moved[at].T @ turns)
        rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    each = np.array([_peak(turns[p], [m[p] for m in moved], shifts, rotation)[0] for p in parts])
    if len(each) < 3:
        return offset_s + best, step_s, score
    spread = 1.4826 * float(np.median(np.abs(each - np.median(each))))
    return offset_s + best, max(spread, FINE_S) / float(np.sqrt(len(each))), score


def _peak(
    turns: Array, moved: list[Array], shifts: Array, log_from_camera: Array | None
) -> tuple[float, float]:
    seen = turns if log_from_camera is None else turns @ log_from_camera.T
    correlation = np.stack([m.T @ seen for m in moved])
    energy = np.array([(m**2).sum() for m in moved]) * (seen**2).sum()
    scores = _agreement(correlation, log_from_camera is not None) / np.sqrt(energy + 1e-18)
    i = int(np.clip(np.argmax(scores), 1, len(scores) - 2))
    a, b, c = scores[i - 1 : i + 2]
    bend = a - 2 * b + c
    part = 0.5 * (a - c) / bend if bend < 0 else 0.0
    return float(shifts[i] + np.clip(part, -1, 1) * FINE_S), float(scores.max())
