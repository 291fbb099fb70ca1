"""Competing relative-pose hypotheses of two views.

An essential matrix explains a scene with depth, a homography a plane (nadir surveys); both are
scored (after Mur-Artal et al., 2015). Measured attitudes add an upright solution and one with the
measured rotation.
"""

from __future__ import annotations

import cv2
import numpy as np

from companion.geometry.transforms import Array, Pose, angle_between
from companion.slam.optimisation.upright_motion import upright_motion

MAX_PRIOR_DISAGREEMENT_RAD = np.radians(8.0)
GAMMA = 5.991
UPRIGHT_PX = 2.0


def motion_hypotheses(
    xa: Array, xb: Array, focal_px: float, seed: int, attitudes: tuple[Array, Array] | None
) -> list[Pose]:
    """Hypotheses `b_from_a` with unit baselines.

    `xa` and `xb` (N, 2) are normalised; `attitudes` are `ned_from_camera` of both, where measured.
    """
    motions: list[Pose] = []
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
        motions += [Pose(r, s * direction) for r in rotations for s in (1.0, -1.0)]
    if homography is not None and (planar or essential is None or attitudes is None):
        _, rotations_h, translations_h, _ = cv2.decomposeHomographyMat(homography, np.eye(3))
        for r, t in zip(rotations_h, translations_h, strict=True):
            norm = float(np.linalg.norm(t))
            if norm > 1e-6 and np.linalg.det(r) > 0:
                unit = np.asarray(t, np.float64).ravel() / norm
                motions.append(Pose(np.asarray(r, np.float64), unit))
    if attitudes is not None:
        rotation_prior = attitudes[1].T @ attitudes[0]
        upright = upright_motion(xa, xb, *attitudes, UPRIGHT_PX / focal_px, seed)
        motions += [] if upright is None else [upright[0]]
        motions += _with_known_rotation(rotation_prior, xa, xb)
        motions = [
            m
            for m in motions
            if angle_between(m.rotation, rotation_prior) < MAX_PRIOR_DISAGREEMENT_RAD
        ]
    return motions


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
    """Both signs of the translation direction that fits most rays with this rotation."""
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
