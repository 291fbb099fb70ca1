"""Least-squares fit of lens, board curvature and board poses, optionally robust.

The board need not be flat: its curvature is estimated. A sag of half a hundredth of its width, as
of paper on cardboard, would otherwise bias the focal length by one hundredth without showing in the
residuals.

Both lens models use the same solver (Levenberg-Marquardt, poses eliminated per view), so that
errors and standard deviations are comparable. OpenCV's fisheye solver gives no standard deviations
and fails on views near the edge.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.calibration.board_image import (
    N_CURVATURE,
    LensModel,
    camera_of,
    project_with_jacobians,
    reprojection_residual,
)
from companion.calibration.board_pose import board_pose
from companion.calibration.board_views import View
from companion.geometry.camera import Camera, Distortion
from companion.geometry.transforms import Array

INITIAL_FOV_DEG = {
    Distortion.RADTAN: (35, 60, 85, 110),
    Distortion.EQUIDISTANT: (40, 75, 110, 145, 180),
}
"""Horizontal fields of view tried as initial guesses; the best fit is kept."""
N_INITIAL_VIEWS = 12
"""Views used for that."""
MAX_STEPS = 30
CONVERGED = 1e-8
"""Relative decrease of the cost at convergence."""


@dataclass(frozen=True, slots=True, eq=False)
class LensFit:
    """A lens, board poses and residuals."""

    model: LensModel
    width: int
    height: int
    parameters: Array
    """Lens fx fy cx cy k..., then a b c of the board depth a x^2 + b x y + c y^2, in metres."""
    poses: tuple[Array, ...]
    """Poses camera_from_board of the views: rotation vector and translation, (6,) each."""
    residuals_px: tuple[Array, ...]
    """Observed minus projected corners, (N, 2) of each view."""
    numbers: tuple[int, ...]
    """Numbers of the views."""
    cost: float

    @property
    def camera(self) -> Camera:
        """Camera with this lens."""
        return camera_of(self.model, self.parameters, self.width, self.height)

    def sag_m(self, board_m: Array) -> float:
        """Largest depth of the board sides against its middle, for corners (N, 3)."""
        half = np.ptp(board_m[:, :2], axis=0) / 2
        a, b, c = self.parameters[-N_CURVATURE:]
        depths = [a * x * x + b * x * y + c * y * y for x in (0, half[0]) for y in (0, half[1])]
        return float(max(np.abs(depths)))

    @property
    def rms_px(self) -> float:
        """RMS reprojection error."""
        return rms_px(self.residuals_px)

    def tilts(self) -> Array:
        """Sines (V, 2) of the tilt of the board normal in each view, right and down."""
        normals = [cv2.Rodrigues(pose[:3])[0][:, 2] for pose in self.poses]
        return np.array([n[:2] * np.sign(n[2] or 1.0) for n in normals]).reshape(-1, 2)


def rms_px(residuals_px: Sequence[Array]) -> float:
    """RMS length of residuals (N, 2)."""
    every = np.concatenate(residuals_px)
    return float(np.sqrt((every**2).sum(1).mean()))


def initial_lens(views: Sequence[View], model: LensModel, huber_px: float) -> LensFit | None:
    """Initial lens from some of the views; None without a solution.

    Residuals beyond `huber_px` have linear cost.
    """
    width, height = views[0].width, views[0].height
    at = np.unique(
        np.linspace(0, len(views) - 1, min(N_INITIAL_VIEWS, len(views))).round().astype(int)
    )
    rough = LensModel(model.distortion, min(2, model.n_free), curved=False)
    best: LensFit | None = None
    for fov_deg in INITIAL_FOV_DEG[model.distortion]:
        half = math.radians(fov_deg) / 2
        focal = width / 2 / (math.tan(half) if model.distortion is Distortion.RADTAN else half)
        guess = np.zeros(model.n_lens + N_CURVATURE)
        guess[:4] = focal, focal, (width - 1) / 2, (height - 1) / 2
        some = [views[i] for i in at if board_pose(views[i], rough, guess) is not None]
        if len(some) < max(3, len(at) // 2):
            continue
        tried = _solve(some, rough, guess, huber_px, 15)
        if tried is not None and (best is None or _mean_cost(tried) < _mean_cost(best)):
            best = tried
    return best


def fit_lens(
    views: Sequence[View], model: LensModel, start: LensFit, *, huber_px: float = math.inf
) -> LensFit | None:
    """Fit a lens to views from an initial one.

    None where a view has no pose under `start`. Residuals beyond `huber_px` have linear cost.
    """
    if start.model.distortion is not model.distortion:
        raise ValueError("a lens of another kind is no beginning")
    parameters = start.parameters.copy()
    kept = np.ones(len(parameters), np.bool_)
    kept[model.free] = False
    parameters[kept] = 0
    known = dict(zip(start.numbers, start.poses, strict=True))
    return _solve(views, model, parameters, huber_px, MAX_STEPS, known)


def residuals_of(lens: LensFit, view: View) -> Array:
    """Residuals (N, 2) of a view with only the board pose fitted."""
    pose = board_pose(view, lens.model, lens.parameters)
    if pose is None:
        return np.full((view.n_corners, 2), np.nan)
    return reprojection_residual(view, lens.model, lens.parameters, pose)


def standard_deviations(lens: LensFit, views: Sequence[View]) -> Array:
    """Standard deviations of the lens parameters from the residuals; 0 if fixed."""
    free = lens.model.free
    n_free = len(free)
    schur = np.zeros((n_free, n_free))
    for view, pose in zip(views, lens.poses, strict=True):
        _, by_lens, by_pose = project_with_jacobians(view, lens.model, lens.parameters, pose)
        a, b = by_lens[:, free], by_pose
        schur += a.T @ a - a.T @ b @ np.linalg.pinv(b.T @ b) @ b.T @ a
    n_measured = 2 * sum(view.n_corners for view in views)
    n_known = n_measured - n_free - 6 * len(views)
    squares = sum(float((r**2).sum()) for r in lens.residuals_px)
    variance = squares / max(n_known, 1)
    scale = 1 / np.sqrt(np.maximum(np.diag(schur), 1e-300))  # parameters differ in magnitude
    covariance = np.linalg.pinv(schur * np.outer(scale, scale), rcond=1e-14, hermitian=True)
    out = np.zeros(len(lens.parameters))
    out[free] = scale * np.sqrt(np.maximum(np.diag(covariance), 0) * variance)
    return out


def _solve(
    views: Sequence[View], model: LensModel, parameters: Array, huber_px: float, max_steps: int,
    known_poses: Mapping[int, Array] = MappingProxyType({}),
) -> LensFit | None:  # fmt: skip
    first = [
        known_poses[view.number]
        if view.number in known_poses
        else board_pose(view, model, parameters)
        for view in views
    ]
    if sum(pose is not None for pose in first) < len(views):
        return None
    poses = [pose for pose in first if pose is not None]
    parameters = parameters.copy()
    free = model.free
    damping = 1e-3
    residuals = _all_residuals(views, model, parameters, poses)
    cost = _cost(residuals, huber_px)
    if not math.isfinite(cost):
        return None
    for _ in range(max_steps):
        blocks = [
            _block(view, model, parameters, pose, free, huber_px)
            for view, pose in zip(views, poses, strict=True)
        ]
        fell = False
        while damping < 1e8:
            step, pose_steps = _step(blocks, damping)
            tried = parameters.copy()
            tried[free] += step
            tried_poses = [pose + d for pose, d in zip(poses, pose_steps, strict=True)]
            tried_cost = math.inf
            if (tried[:2] > 0).all():
                residuals = _all_residuals(views, model, tried, tried_poses)
                tried_cost = _cost(residuals, huber_px)
            if tried_cost < cost:
                fell = True
                break
            damping *= 10
        if not fell:
            break
        gain = (cost - tried_cost) / max(cost, 1e-300)
        parameters, poses, cost = tried, tried_poses, tried_cost
        damping = max(damping / 10, 1e-9)
        if gain < CONVERGED:
            break
    residuals = _all_residuals(views, model, parameters, poses)
    return LensFit(
        model, views[0].width, views[0].height, parameters, tuple(poses), tuple(residuals),
        tuple(view.number for view in views), cost,
    )  # fmt: skip


Block = tuple[Array, Array, Array, Array, Array]


def _block(
    view: View, model: LensModel, parameters: Array, pose: Array, free: NDArray[np.int64],
    huber_px: float,
) -> Block:  # fmt: skip
    """Normal equations of one view: lens, lens-pose, pose, and both right-hand sides."""
    pixels, by_lens, by_pose = project_with_jacobians(view, model, parameters, pose)
    residual = view.detection.image_px - pixels
    weight = np.repeat(np.sqrt(_weights(residual, huber_px)), 2)
    a, b = by_lens[:, free] * weight[:, None], by_pose * weight[:, None]
    r = residual.reshape(-1) * weight
    return a.T @ a, a.T @ b, b.T @ b, a.T @ r, b.T @ r


def _step(blocks: Sequence[Block], damping: float) -> tuple[Array, list[Array]]:
    n = len(blocks[0][0])
    left, right = np.zeros((n, n)), np.zeros(n)
    diagonal = np.zeros(n)
    inverses = []
    for aa, ab, bb, ar, br in blocks:
        inverse = np.linalg.inv(bb + damping * np.diag(np.diag(bb)))
        inverses.append(inverse)
        left += aa - ab @ inverse @ ab.T
        right += ar - ab @ inverse @ br
        diagonal += np.diag(aa)
    scale = 1 / np.sqrt(np.maximum(diagonal, 1e-300))
    scaled = left * np.outer(scale, scale) + damping * np.eye(n)
    step: Array = scale * np.linalg.lstsq(scaled, right * scale, rcond=None)[0]
    pose_steps: list[Array] = [
        inverse @ (br - ab.T @ step)
        for inverse, (_, ab, _, _, br) in zip(inverses, blocks, strict=True)
    ]
    return step, pose_steps


def _weights(residual: Array, huber_px: float) -> Array:
    distance_px = np.linalg.norm(residual, axis=1)
    weights: Array = np.minimum(1.0, huber_px / np.maximum(distance_px, 1e-12))
    return weights


def _mean_cost(lens: LensFit) -> float:
    return lens.cost / sum(len(residuals) for residuals in lens.residuals_px)


def _cost(residuals: Sequence[Array], huber_px: float) -> float:
    distance_px = np.linalg.norm(np.concatenate(residuals), axis=1)
    near = np.minimum(distance_px, huber_px)
    return float((near * (2 * distance_px - near)).sum())


def _all_residuals(
    views: Sequence[View], model: LensModel, parameters: Array, poses: Sequence[Array]
) -> list[Array]:
    return [
        reprojection_residual(view, model, parameters, pose)
        for view, pose in zip(views, poses, strict=True)
    ]
