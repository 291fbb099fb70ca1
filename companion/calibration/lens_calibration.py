"""Lens calibration: model selection, outlier rejection, uncertainty."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from companion.calibration.board_image import LensModel
from companion.calibration.board_views import Coverage, Mask, View, coverage
from companion.calibration.chart import MIN_CORNERS, Detection
from companion.calibration.lens_fit import (
    LensFit,
    fit_lens,
    initial_lens,
    residuals_of,
    rms_px,
    standard_deviations,
)
from companion.geometry.camera import Camera, Distortion
from companion.geometry.transforms import Array

MODELS = {
    "radtan": (LensModel(Distortion.RADTAN, 4), LensModel(Distortion.RADTAN, 5)),
    "equidistant": (LensModel(Distortion.EQUIDISTANT, 2), LensModel(Distortion.EQUIDISTANT, 4)),
}
"""Variants of each `--model`; more coefficients are used only where they improve the fit."""
MIN_IMPROVEMENT = 0.98
"""Ratio of held-out errors below which a more complex model is preferred."""
N_FOLDS = 5
ROUGH_RATIO = 0.002
"""Relative to the image diagonal: residuals of an unconverged lens."""
OUTLIER_SIGMAS = 5.0
MIN_OUTLIER_RATIO = 0.0005
"""Relative to the diagonal: smaller residuals are no outliers."""
VIEW_OUTLIER = 3.0
"""Ratio to the median error above which a view is rejected."""
MAX_CORNERS_LOST = 0.25
"""Ratio of rejected corners above which a view is rejected."""


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A calibrated lens with its quality measures."""

    lens: LensFit
    views: tuple[View, ...]
    """Views used, without outlier corners."""
    rejected: tuple[View, ...]
    """Views inconsistent with the others."""
    n_corners_rejected: int
    holdout_px: float
    """RMS error in held-out views."""
    sigmas: Array
    """Standard deviations of fx fy cx cy k..."""
    coverage: Coverage

    @property
    def camera(self) -> Camera:
        """Camera with this lens."""
        return self.lens.camera

    @property
    def rms_px(self) -> float:
        """RMS error in the views used."""
        return self.lens.rms_px

    @property
    def sag_m(self) -> float:
        """Deviation of the board from a plane."""
        return self.lens.sag_m(self._corners_m())

    @property
    def sag(self) -> float:
        """The same relative to the longer side of the board."""
        return self.sag_m / float(np.ptp(self._corners_m()[:, :2], axis=0).max())

    def _corners_m(self) -> Array:
        return np.concatenate([view.detection.board_m for view in self.views])

    @property
    def views_px(self) -> list[float]:
        """RMS error of each view."""
        return [rms_px([residual]) for residual in self.lens.residuals_px]


def calibrate_lens(views: Sequence[View], lit: Mask, wanted: str) -> Calibration | None:
    """Calibrate from views; None without a solution.

    `wanted` is a key of `MODELS`, or "auto" for the one of least held-out error.
    """
    if len(views) < 4:
        return None
    names = list(MODELS) if wanted == "auto" else [wanted]
    rough_px = ROUGH_RATIO * views[0].diagonal_px
    starts: dict[Distortion, LensFit] = {}
    for name in names:
        start = initial_lens(views, MODELS[name][-1], rough_px)
        if start is not None:
            starts[start.model.distortion] = start
    models = [model for name in names for model in MODELS[name] if model.distortion in starts]
    cleaned = _reject_outliers(views, models, starts, rough_px)
    if cleaned is None:
        return None
    kept, rejected, n_corners = cleaned
    tried = _held_out(kept, models, starts)
    fits: dict[LensModel, LensFit] = {}
    for model in tried:
        lens = fit_lens(kept, model, starts[model.distortion])
        if lens is not None:
            fits[model] = lens
    if not fits:
        return None
    # a distortion not invertible within the image is useless, however well it fits
    sound = [model for model in fits if not folds(fits[model].camera)] or list(fits)
    chosen = sound[0]
    for model in sound[1:]:
        if tried[model] < MIN_IMPROVEMENT * tried[chosen]:
            chosen = model
    lens = fits[chosen]
    return Calibration(
        lens, tuple(kept), tuple(rejected), n_corners, tried[chosen],
        standard_deviations(lens, kept), coverage(kept, lit),
    )  # fmt: skip


def folds(camera: Camera) -> bool:
    """True if the distortion is not invertible within the image.

    The image circle of a fisheye may end before the corners, so only radtan lenses are checked.
    """
    if camera.distortion is not Distortion.RADTAN:
        return False
    right, bottom = camera.width - 1.0, camera.height - 1.0
    along = np.linspace(0, 1, 33)
    border = np.concatenate([
        np.stack([right * along, 0 * along], 1), np.stack([right * along, 0 * along + bottom], 1),
        np.stack([0 * along, bottom * along], 1), np.stack([0 * along + right, bottom * along], 1),
    ])  # fmt: skip
    centre = np.array([camera.cx, camera.cy])
    rays = np.array([camera.normalise(centre + s * (border - centre)) for s in (0.6, 0.8, 0.9, 1)])
    if not np.isfinite(rays).all():
        return True
    outward = np.diff(np.linalg.norm(rays, axis=-1), axis=0)
    turned = np.linalg.det(camera.pixel_from_normalised_jacobian(rays.reshape(-1, 2)))
    return bool((outward <= 0).any() or (turned <= 0).any())


def _reject_outliers(
    views: Sequence[View], models: Sequence[LensModel], starts: dict[Distortion, LensFit],
    rough_px: float,
) -> tuple[list[View], list[View], int] | None:  # fmt: skip
    """Views kept, views rejected, number of corners rejected; `starts` is refined."""
    best: LensFit | None = None
    kept: list[View] = []
    for model in models:
        start = starts[model.distortion]
        usable = [view for view in views if np.isfinite(residuals_of(start, view)).all()]
        lens = fit_lens(usable, model, start, huber_px=rough_px) if len(usable) > 3 else None
        if lens is None:
            continue
        starts[model.distortion] = lens
        # a view without a pose has the largest cost
        cost = lens.cost + (len(views) - len(usable)) * 24 * rough_px**2
        if best is None or cost < best.cost:
            best, kept = dataclasses.replace(lens, cost=cost), usable
    if best is None:
        return None
    n_lost = 0
    for _ in range(5):
        before = [view.n_corners for view in kept]
        kept, n_now = _reject_once(kept, best)
        n_lost += n_now
        if len(kept) < 4:
            return None
        if [view.n_corners for view in kept] == before:
            break
        again = fit_lens(kept, best.model, best, huber_px=rough_px)
        if again is None:
            return None
        best = again
    starts[best.model.distortion] = best
    numbers = {view.number for view in kept}
    return kept, [view for view in views if view.number not in numbers], n_lost


def _reject_once(views: Sequence[View], lens: LensFit) -> tuple[list[View], int]:
    distance_px = [np.linalg.norm(residual, axis=1) for residual in lens.residuals_px]
    every = np.concatenate(distance_px)
    least_px = MIN_OUTLIER_RATIO * views[0].diagonal_px
    limit_px = max(OUTLIER_SIGMAS * float(np.median(every)) / 1.177, least_px)
    errors = np.array([float(np.sqrt((one**2).mean())) for one in distance_px])
    view_limit_px = max(VIEW_OUTLIER * float(np.median(errors)), least_px)
    kept, n_lost = [], 0
    for view, one in zip(views, distance_px, strict=True):
        good = one <= limit_px
        if good.all():
            kept.append(view)
            continue
        error = float(np.sqrt((one[good] ** 2).mean())) if good.any() else np.inf
        if error > view_limit_px or good.sum() < max(
            MIN_CORNERS, (1 - MAX_CORNERS_LOST) * len(good)
        ):
            continue
        n_lost += int((~good).sum())
        kept.append(dataclasses.replace(view, detection=_part(view.detection, good)))
    return kept, n_lost


def _part(detection: Detection, good: Mask) -> Detection:
    return Detection(
        detection.ids[good], detection.image_px[good], detection.board_m[good], detection.edge_px
    )


def _held_out(
    views: Sequence[View], models: Sequence[LensModel], starts: dict[Distortion, LensFit]
) -> dict[LensModel, float]:
    """Cross-validated error of each model that could be fitted."""
    out = {}
    fold = np.arange(len(views)) % N_FOLDS
    for model in models:
        residuals: list[Array] = []
        for number in range(min(N_FOLDS, len(views))):
            shown = [view for view, f in zip(views, fold, strict=True) if f != number]
            held = [view for view, f in zip(views, fold, strict=True) if f == number]
            lens = fit_lens(shown, model, starts[model.distortion])
            if lens is None:
                break
            residuals += [residuals_of(lens, view) for view in held]
        else:
            error = rms_px(residuals)
            if np.isfinite(error):
                out[model] = error
    return out
