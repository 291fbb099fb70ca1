"""Time alignment of a log with a video by camera rotation: correlation of two records.

The body rotates as the camera fixed to it, up to a constant rotation. Both are correlated over all
shifts; where the constant rotation is unknown, the best one at each shift is used, whose score is
the sum of the singular values of the correlation (Kabsch 1976).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft
from scipy.ndimage import uniform_filter1d

from companion.geometry.transforms import Array, nearest_rotation

SMOOTH_S = 4.0
"""Slower changes are filtered out: gyroscope drift, and translation seen as rotation."""
MIN_OVERLAP_S = 10.0
MIN_OVERLAP_RATIO = 0.5
PEAK_WIDTH_S = 1.0
"""Shifts within this of the best one belong to its peak."""
MIN_SCORE = 0.35
MAX_SECOND, MAX_UNEXPLAINED, MIN_UNEXPLAINED = 0.7, 0.35, 0.02
"""A shift is unambiguous if others score less by these ratios, or leave more unexplained."""
MIN_RATE_RAD_S = 0.004
N_BLOCKS = 8
MIN_BLOCK_S = 5.0
FINE_S = 0.002


@dataclass(frozen=True, slots=True, eq=False)
class RotationRecord:
    """Integrated rotation `angle_rad` (N, 3) at ascending times `t_s` (N,)."""

    t_s: Array
    angle_rad: Array

    def rates(self, t_s: Array) -> Array:
        """Mean rates (M - 1, 3) between times (M,)."""
        angle = np.stack([np.interp(t_s, self.t_s, a) for a in self.angle_rad.T], 1)
        out: Array = np.diff(angle, axis=0) / np.diff(t_s)[:, None]
        return out


@dataclass(frozen=True, slots=True)
class TimeAlignment:
    """Time offset of a log: add `offset_s` to its times.

    `score` is the correlation, at most 1; `second` the best score of another peak, at
    `second_offset_s`.
    """

    offset_s: float
    sigma_s: float
    score: float
    second: float
    second_offset_s: float
    rms_rate_rad_s: float

    @property
    def why_not(self) -> str | None:
        """Reason why it is not reliable; None if it is."""
        if self.rms_rate_rad_s < MIN_RATE_RAD_S:
            return "the camera hardly turns"
        if self.score < MIN_SCORE:
            return f"the rotations agree badly, {self.score:.2f} of 1"
        unexplained = max(1 - self.score**2, MIN_UNEXPLAINED) / (1 - min(self.second, 0.9999) ** 2)
        if self.second > MAX_SECOND * self.score and unexplained > MAX_UNEXPLAINED:
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


def align_rotations(
    camera: RotationRecord, log: RotationRecord, step_s: float, log_from_camera: Array | None = None
) -> TimeAlignment | None:
    """Shift of the log that aligns its rotation with the camera; None where too short.

    `step_s` is the frame period; `log_from_camera` (3, 3) the constant rotation, where known.
    """
    grid = [np.arange(r.t_s[0], r.t_s[-1], step_s) for r in (camera, log)]
    if min(len(g) for g in grid) * step_s < MIN_OVERLAP_S:
        return None
    rates, log_rates = (
        _high_pass(r.rates(g), step_s) for r, g in zip((camera, log), grid, strict=True)
    )
    if log_from_camera is not None:
        rates = rates @ log_from_camera.T
    scores, lags = _scores(rates, log_rates, step_s, log_from_camera is not None)
    best = int(np.argmax(scores))
    # a rotation at camera time t is in the log at t - offset
    offset_s = float(grid[0][0] - grid[1][0] - lags[best] * step_s)
    outside_peak = np.abs(lags - lags[best]) * step_s > PEAK_WIDTH_S
    second_best = int(np.argmax(np.where(outside_peak, scores, -np.inf)))
    fine_s, sigma_s, score = _refine(camera, log, offset_s, step_s, log_from_camera)
    return TimeAlignment(
        fine_s, sigma_s, score, float(scores[second_best]) if outside_peak.any() else 0.0,
        float(grid[0][0] - grid[1][0] - lags[second_best] * step_s),
        float(np.sqrt((rates**2).sum(1).mean())),
    )  # fmt: skip


def _high_pass(rates: Array, step_s: float) -> Array:
    """High-pass filtered rates, clipped."""
    n = max(3, round(SMOOTH_S / step_s))
    high = rates - uniform_filter1d(rates, n, axis=0, mode="nearest")
    most = 6 * np.sqrt((high**2).mean(0)) + 1e-9
    out: Array = np.clip(high, -most, most)
    return out


def _scores(
    rates: Array, log_rates: Array, step_s: float, known: bool
) -> tuple[Array, NDArray[np.int64]]:
    """Scores, and the lags in steps of the camera record after the log."""
    n, m = len(rates), len(log_rates)
    size = next_fast_len(n + m)
    spectra = rfft(rates, size, axis=0), rfft(log_rates, size, axis=0)
    product = irfft(spectra[1][:, :, None] * np.conj(spectra[0])[:, None, :], size, axis=0)
    least = max(round(MIN_OVERLAP_S / step_s), round(MIN_OVERLAP_RATIO * min(n, m)))
    lags = np.arange(least - n, m - least + 1, dtype=np.int64)
    correlation = product[lags % size]
    energy = [np.concatenate([[0.0], np.cumsum((r**2).sum(1))]) for r in (rates, log_rates)]
    first, last = np.maximum(0, -lags), np.minimum(n, m - lags)
    camera_energy = energy[0][last] - energy[0][first]
    log_energy = energy[1][last + lags] - energy[1][first + lags]
    agreement = _agreement(correlation, known) / np.sqrt(camera_energy * log_energy + 1e-18)
    # overlaps with little rotation correlate by chance
    share = np.maximum(
        camera_energy / (energy[0][-1] + 1e-18), log_energy / (energy[1][-1] + 1e-18)
    )
    return np.asarray(agreement * np.sqrt(share), np.float64), lags


def _agreement(correlation: Array, known: bool) -> Array:
    if known:
        return np.asarray(np.trace(correlation, axis1=1, axis2=2), np.float64)
    u, s, vt = np.linalg.svd(correlation)
    s[:, 2] *= np.sign(np.linalg.det(u @ vt))
    out: Array = s.sum(1)
    return out


def _refine(
    camera: RotationRecord, log: RotationRecord, offset_s: float, step_s: float,
    log_from_camera: Array | None,
) -> tuple[float, float, float]:  # fmt: skip
    """Sub-step shift, its standard deviation, and the score."""
    inside = (camera.t_s >= log.t_s[0] + offset_s) & (camera.t_s <= log.t_s[-1] + offset_s)
    t_s = camera.t_s[inside]
    rates = _high_pass(camera.rates(t_s), step_s)
    shifts = np.arange(-1.5 * step_s, 1.5 * step_s + FINE_S, FINE_S)
    shifted = [_high_pass(log.rates(t_s - offset_s - shift), step_s) for shift in shifts]
    best, score = _peak(rates, shifted, shifts, log_from_camera)
    n = min(N_BLOCKS, int((t_s[-1] - t_s[0]) / MIN_BLOCK_S))
    parts = np.array_split(np.arange(len(rates)), max(n, 1))
    rotation = log_from_camera
    if rotation is None:  # estimated over all blocks: a single one may not determine it
        at = int(np.abs(shifts - best).argmin())
        rotation = nearest_rotation(shifted[at].T @ rates)
    each = np.array([_peak(rates[p], [m[p] for m in shifted], shifts, rotation)[0] for p in parts])
    if len(each) < 3:
        return offset_s + best, step_s, score
    spread = 1.4826 * float(np.median(np.abs(each - np.median(each))))
    return offset_s + best, max(spread, FINE_S) / float(np.sqrt(len(each))), score


def _peak(
    rates: Array, shifted: list[Array], shifts: Array, log_from_camera: Array | None
) -> tuple[float, float]:
    seen = rates if log_from_camera is None else rates @ log_from_camera.T
    correlation = np.stack([m.T @ seen for m in shifted])
    energy = np.array([(m**2).sum() for m in shifted]) * (seen**2).sum()
    scores = _agreement(correlation, log_from_camera is not None) / np.sqrt(energy + 1e-18)
    i = int(np.clip(np.argmax(scores), 1, len(scores) - 2))
    a, b, c = scores[i - 1 : i + 2]
    curvature = a - 2 * b + c
    part = 0.5 * (a - c) / curvature if curvature < 0 else 0.0
    return float(shifts[i] + np.clip(part, -1, 1) * FINE_S), float(scores.max())
