"""The lens of a camera from views of a board: model chosen, outliers left out, errors stated."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from companion.calibration.board_image import LensModel
from companion.calibration.board_views import Coverage, Mask, View, coverage
from companion.calibration.chart import MIN_CORNERS, Sighting
from companion.calibration.lens_fit import (
    LensFit,
    first_lens,
    fit_lens,
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
"""What each `--model` may be; the fewer coefficients are taken unless more of them serve."""
WORTH = 0.98
"""A model with more freedom must bring the held-out error under this share of the simpler one's."""
N_FOLDS = 5
ROUGH_SHARE = 0.002
"""Of the picture's diagonal: residuals up to this may come of a lens not yet right."""
OUTLIER_SIGMAS = 5.0
OUTLIER_LEAST_SHARE = 0.0005
"""Of the diagonal: a corner or view no further off than this is no outlier."""
VIEW_OUTLIER = 3.0
"""A view whose error is more than this many times the median is left out."""
MAX_LOST = 0.25
"""A view that has lost more of its corners than this is left out."""


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A lens and what speaks for it."""

    lens: LensFit
    views: tuple[View, ...]
    """Those that the lens was fitted to, less corners that were outliers."""
    rejected: tuple[View, ...]
    """Views that no lens explains together with the others."""
    n_corners_rejected: int
    holdout_px: float
    """Root mean square error in views that the lens was not fitted to."""
    sigmas: Array
    """Standard deviations of the lens's parameters, fx fy cx cy k…"""
    tried_px: dict[str, float]
    """Held-out error of each model that was tried."""
    coverage: Coverage

    @property
    def camera(self) -> Camera:
        """The lens as the rest of the program has it."""
        return self.lens.camera

    @property
    def rms_px(self) -> float:
        """Root mean square error in the views that it was fitted to."""
        return self.lens.rms_px

    @property
    def sag_m(self) -> float:
        """How far the board is from flat."""
        return self.lens.sag_m(self._corners_m())

    @property
    def sag(self) -> float:
        """The same as a share of the board's longer side."""
        return self.sag_m / float(np.ptp(self._corners_m()[:, :2], axis=0).max())

    def _corners_m(self) -> Array:
        return np.concatenate([view.sighting.board_m for view in self.views])

    @property
    def views_px(self) -> list[float]:
        """The same for each view."""
        return [rms_px([residual]) for residual in self.lens.residuals_px]


def determine(views: Sequence[View], lit: Mask, wanted: str) -> Calibration | None:
    """The lens that explains the views; None where there is none.

    `wanted` is a key of `MODELS`, or "auto" for whichever does better on views held out.
    """
    if len(views) < 4:
        return None
    names = list(MODELS) if wanted == "auto" else [wanted]
    rough_px = ROUGH_SHARE * views[0].diagonal_px
    starts: dict[Distortion, LensFit] = {}
    for name in names:
        start = first_lens(views, MODELS[name][-1], rough_px)
        if start is not None:
            starts[start.model.distortion] = start
    models = [model for name in names for model in MODELS[name] if model.distortion in starts]
    cleaned = _without_outliers(views, models, starts, rough_px)
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
    # one that folds within the picture cannot be undone there, however well it fits
    sound = [model for model in fits if not folds(fits[model].camera)] or list(fits)
    chosen = sound[0]
    for model in sound[1:]:
        if tried[model] < WORTH * tried[chosen]:
            chosen = model
    lens = fits[chosen]
    return Calibration(
        lens, tuple(kept), tuple(rejected), n_corners, tried[chosen],
        standard_deviations(lens, kept), {_label(model): px for model, px in tried.items()},
        coverage(kept, lit),
    )  # fmt: skip


def folds(camera: Camera) -> bool:
    """Whether some place near the edge of the picture has no ray, or that of another place.

    A fisheye's picture may end before its corners, so that only a radtan lens can be asked this.
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


def _without_outliers(
    views: Sequence[View], models: Sequence[LensModel], starts: dict[Distortion, LensFit],
    rough_px: float,
) -> tuple[list[View], list[View], int] | None:  # fmt: skip
    """Views kept, views rejected, and how many corners of those kept; `starts` is improved."""
    best: LensFit | None = None
    kept: list[View] = []
    for model in models:
        start = starts[model.distortion]
        usable = [view for view in views if np.isfinite(residuals_of(start, view)).all()]
        lens = fit_lens(usable, model, start, huber_px=rough_px) if len(usable) > 3 else None
        if lens is None:
            continue
        starts[model.distortion] = lens
        # a view that a model cannot even place counts as badly as can be
        cost = lens.cost + (len(views) - len(usable)) * 24 * rough_px**2
        if best is None or cost < best.cost:
            best, kept = dataclasses.replace(lens, cost=cost), usable
    if best is None:
        return None
    n_lost = 0
    for _ in range(5):
        before = [view.n_corners for view in kept]
        kept, n_now = _one_cleaning(kept, best)
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


def _one_cleaning(views: Sequence[View], lens: LensFit) -> tuple[list[View], int]:
    away = [np.linalg.norm(residual, axis=1) for residual in lens.residuals_px]
    every = np.concatenate(away)
    least_px = OUTLIER_LEAST_SHARE * views[0].diagonal_px
    limit_px = max(OUTLIER_SIGMAS * float(np.median(every)) / 1.177, least_px)
    errors = np.array([float(np.sqrt((one**2).mean())) for one in away])
    view_limit_px = max(VIEW_OUTLIER * float(np.median(errors)), least_px)
    kept, n_lost = [], 0
    for view, one in zip(views, away, strict=True):
        good = one <= limit_px
        if good.all():
            kept.append(view)
            continue
        error = float(np.sqrt((one[good] ** 2).mean())) if good.any() else np.inf
        if error > view_limit_px or good.sum() < max(MIN_CORNERS, (1 - MAX_LOST) * len(good)):
            continue
        n_lost += int((~good).sum())
        kept.append(dataclasses.replace(view, sighting=_part(view.sighting, good)))
    return kept, n_lost


def _part(sighting: Sighting, good: Mask) -> Sighting:
    return Sighting(
        sighting.ids[good], sighting.image_px[good], sighting.board_m[good], sighting.edge_px
    )


def _held_out(
    views: Sequence[View], models: Sequence[LensModel], starts: dict[Distortion, LensFit]
) -> dict[LensModel, float]:
    """For each model the error in views that it was not fitted to, where it could be fitted."""
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


def _label(model: LensModel) -> str:
    return f"{model.distortion.value} {model.n_free}"
