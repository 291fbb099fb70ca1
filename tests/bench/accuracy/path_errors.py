"""Trajectory error: absolute (ATE) and relative (RPE) errors, scale, heading.

After Sturm et al. (IROS 2012): ATE after the best alignment, RPE between consecutive frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.geometry.transforms import Array, Similarity, quaternion_from_rotation

MAX_TIME_DIFFERENCE_NS = 4_000_000
"""Largest time difference of poses of the same frame."""


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """Poses in order of time: `t_ns` (N,), `centres` (N, 3), `rotations` (N, 3, 3)."""

    t_ns: Array
    centres: Array
    rotations: Array

    def __len__(self) -> int:
        return len(self.t_ns)

    def at(self, index: NDArray[np.int64]) -> Path:
        """Subset of the poses."""
        return Path(self.t_ns[index], self.centres[index], self.rotations[index])


@dataclass(frozen=True, slots=True)
class PathErrors:
    """RMS errors over the frames that both paths have; lengths in metres.

    `rpe_m` and `rpe_deg` are of the motion from each frame to the next, after alignment by
    similarity. `scale_error` is relative; `heading_error_deg` is the remaining yaw between the two
    worlds.
    """

    n_common: int
    ate_sim3_m: float
    ate_se3_m: float
    ate_yaw_m: float
    rpe_m: float
    rpe_deg: float
    scale_error: float
    heading_error_deg: float
    rotation_deg: float
    path_m: float


def paired(estimate: Path, truth: Path) -> tuple[Path, Path]:
    """Poses of the frames that both have."""
    after = np.clip(np.searchsorted(truth.t_ns, estimate.t_ns), 1, len(truth) - 1)
    before_is_nearer = np.abs(truth.t_ns[after - 1] - estimate.t_ns) < np.abs(
        truth.t_ns[after] - estimate.t_ns
    )
    nearest = np.where(before_is_nearer, after - 1, after)
    same = np.abs(truth.t_ns[nearest] - estimate.t_ns) < MAX_TIME_DIFFERENCE_NS
    return estimate.at(np.flatnonzero(same)), truth.at(nearest[same])


def align(a: Array, b: Array, with_scale: bool) -> Similarity:
    """Similarity from points `a` (N, 3) to `b` with the least squared error (Umeyama 1991)."""
    mean_a, mean_b = a.mean(0), b.mean(0)
    u, singular, vt = np.linalg.svd((b - mean_b).T @ (a - mean_a) / len(a))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    spread = float(((a - mean_a) ** 2).sum(1).mean())
    scale = float((singular * sign).sum()) / max(spread, 1e-18) if with_scale else 1.0
    return Similarity(scale, rotation, mean_b - scale * rotation @ mean_a)


def align_by_yaw(a: Array, b: Array) -> Similarity:
    """As `align`, with rotation about the vertical only."""
    mean_a, mean_b = a.mean(0), b.mean(0)
    p, q = (a - mean_a)[:, :2], (b - mean_b)[:, :2]
    yaw = np.arctan2((p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum(), (p * q).sum())
    c, s = np.cos(yaw), np.sin(yaw)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return Similarity(1.0, rotation, mean_b - rotation @ mean_a)


def path_errors(estimate: Path, truth: Path) -> PathErrors | None:
    """Errors of an estimate; None with fewer than three common frames."""
    found, wanted = paired(estimate, truth)
    if len(found) < 3:
        return None
    by_similarity = align(found.centres, wanted.centres, True)
    rigid = align(found.centres, wanted.centres, False)
    by_yaw = align_by_yaw(found.centres, wanted.centres)
    turned = np.matmul(rigid.rotation, found.rotations)
    off = np.matmul(wanted.rotations.transpose(0, 2, 1), turned)
    rpe_m, rpe_deg = _relative(found, wanted, by_similarity)
    steps = np.linalg.norm(np.diff(truth.centres, axis=0), axis=1)
    return PathErrors(
        len(found),
        _rms(by_similarity.apply(found.centres) - wanted.centres),
        _rms(rigid.apply(found.centres) - wanted.centres),
        _rms(by_yaw.apply(found.centres) - wanted.centres),
        rpe_m, rpe_deg,
        abs(1.0 / by_similarity.scale - 1.0),
        _heading_error_deg(found, wanted),
        float(np.sqrt((_angles_deg(off) ** 2).mean())),
        float(steps.sum()),
    )  # fmt: skip


def _relative(found: Path, wanted: Path, alignment: Similarity) -> tuple[float, float]:
    step_found, turn_found = _steps(found, alignment.scale)
    step_wanted, turn_wanted = _steps(wanted, 1.0)
    off = np.matmul(turn_wanted.transpose(0, 2, 1), turn_found)
    # the difference of two motions, seen in the frame where the true one ends
    apart = np.matmul(turn_wanted.transpose(0, 2, 1), (step_found - step_wanted)[..., None])
    return _rms(apart[..., 0]), float(np.sqrt((_angles_deg(off) ** 2).mean()))


def _steps(path: Path, scale: float) -> tuple[Array, Array]:
    back = path.rotations[:-1].transpose(0, 2, 1)
    step = np.matmul(back, scale * np.diff(path.centres, axis=0)[..., None])[..., 0]
    return step, np.matmul(back, path.rotations[1:])


def _heading_error_deg(found: Path, wanted: Path) -> float:
    """Mean yaw between the attitudes of the two paths, each in its own world."""
    off = np.matmul(found.rotations, wanted.rotations.transpose(0, 2, 1))
    mean = off.mean(0)
    return abs(float(np.degrees(np.arctan2(mean[1, 0] - mean[0, 1], mean[0, 0] + mean[1, 1]))))


def _angles_deg(rotations: Array) -> Array:
    w = np.array([quaternion_from_rotation(r)[0] for r in rotations])
    out: Array = np.degrees(2.0 * np.arccos(np.clip(w, -1.0, 1.0)))
    return out


def _rms(vectors: Array) -> float:
    return float(np.sqrt((vectors**2).sum(1).mean()))
