"""Picture of a calibration's quality."""

from __future__ import annotations

import io
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure

from companion.calibration.calibration_verdict import max_rms_px
from companion.calibration.lens_calibration import Calibration
from companion.geometry.camera import Camera, Distortion
from companion.geometry.transforms import Array

INK, SOFT, GRID, CARD = "#1c1d1f", "#6b6e73", "#dddbd6", "#ffffff"
PATH, OTHER, BAD = "#0b6bcb", "#e08a1e", "#d64545"
STYLE: Any = {
    "font.size": 10.0,
    "axes.edgecolor": GRID, "axes.labelcolor": SOFT, "axes.titlecolor": INK,
    "axes.titlesize": 11.0, "axes.titlelocation": "left", "axes.titleweight": "bold",
    "xtick.color": GRID, "ytick.color": GRID, "xtick.labelcolor": SOFT, "ytick.labelcolor": SOFT,
    "text.color": INK, "axes.axisbelow": True, "legend.frameon": False,
    "figure.facecolor": CARD,
}  # fmt: skip
LONGEST_ARROW = 0.05
"""Longest arrow of a residual, as a share of the picture's width."""


def calibration_png(calibration: Calibration, name: str, board: str) -> bytes:
    """PNG: corner coverage, reprojection residuals, and the distortion of the lens."""
    camera = calibration.camera
    with matplotlib.rc_context(STYLE):
        tall = camera.height / camera.width
        figure = Figure(figsize=(13.6, 2 * 6.0 * tall + 2.2), dpi=110, layout="constrained")
        figure.suptitle(_heading(calibration, name, board), x=0.01, ha="left", fontsize=10.5)
        axes = figure.subplots(2, 2)
        _draw_coverage(axes[0, 0], calibration)
        _draw_residuals(axes[0, 1], calibration)
        _draw_views(axes[1, 0], calibration)
        _draw_distortion(axes[1, 1], camera)
        out = io.BytesIO()
        figure.savefig(out, format="png", metadata={"Software": None})
        return out.getvalue()


def _heading(calibration: Calibration, name: str, board: str) -> str:
    camera = calibration.camera
    fx, fy, cx, cy = (
        f"{label} {value:.2f} ± {sigma:.2f}"
        for label, value, sigma in zip(
            ("fx", "fy", "cx", "cy"), calibration.lens.parameters, calibration.sigmas, strict=False
        )
    )
    return (
        f"{name}: {camera.distortion.value}, {camera.width} x {camera.height}, {board}\n"
        f"{fx}    {fy}    {cx}    {cy} px\n"
        f"error {calibration.rms_px:.3f} px, in views held out {calibration.holdout_px:.3f} px"
    )


def _draw_coverage(axes: Axes, calibration: Calibration) -> None:
    camera = calibration.camera
    covered = calibration.coverage
    shade = np.where(covered.lit, np.where(covered.seen, 0, 1), 2)
    axes.imshow(
        shade, extent=(-0.5, camera.width - 0.5, camera.height - 0.5, -0.5), vmin=0, vmax=2,
        cmap=ListedColormap([CARD, "#fae6cf", "#3c3f44"]), interpolation="nearest", aspect="auto",
    )  # fmt: skip
    points = np.concatenate([view.detection.image_px for view in calibration.views])
    axes.plot(*points.T, ".", ms=3.5, mew=0, color=PATH)
    for view in calibration.rejected:
        axes.plot(*view.detection.image_px.T, "x", ms=3.5, mew=0.8, color=BAD)
    axes.set_title(f"Corners of {len(calibration.views)} views, {covered.share:.0%} covered")
    notes = ["orange: the board never was there"]
    if not covered.lit.all():
        notes.append("dark: no light")
    if calibration.rejected:
        notes.append("crosses: views left out")
    axes.set_xlabel(", ".join(notes))
    _frame(axes, camera)


def _draw_residuals(axes: Axes, calibration: Calibration) -> None:
    camera = calibration.camera
    points = np.concatenate([view.detection.image_px for view in calibration.views])
    residuals = np.concatenate(calibration.lens.residuals_px)
    error_px = np.linalg.norm(residuals, axis=1)
    magnified = _round(LONGEST_ARROW * camera.width / max(float(np.percentile(error_px, 98)), 1e-6))
    lines = LineCollection(
        list(np.stack([points, points + magnified * residuals], 1)), array=error_px, linewidths=0.9,
        cmap=matplotlib.colormaps["viridis_r"],
    )  # fmt: skip
    lines.set_clim(0, float(np.percentile(error_px, 98)))
    axes.add_collection(lines)
    bar = axes.figure.colorbar(lines, ax=axes, pad=0.01, fraction=0.035)
    bar.set_label("px")
    bar.outline.set_visible(False)
    axes.set_title(f"What the lens leaves unexplained, {magnified:g} times magnified")
    _frame(axes, camera)


def _draw_views(axes: Axes, calibration: Calibration) -> None:
    errors = np.array(calibration.views_px)
    limit_px = max_rms_px(calibration.camera.width)
    at = np.arange(len(errors))
    axes.bar(at, errors, width=0.7, color=PATH, label="view")
    axes.axhline(calibration.rms_px, color=INK, lw=1, label="all of them")
    axes.axhline(calibration.holdout_px, color=OTHER, lw=1, ls="--", label="in views held out")
    top = 1.35 * max(float(errors.max()), calibration.holdout_px)
    if limit_px < 2 * top:
        axes.axhline(limit_px, color=BAD, lw=1, label="limit")
        top = max(top, 1.1 * limit_px)
    numbers = [str(view.number) for view in calibration.views]
    every = 1 + (len(numbers) - 1) // 20
    axes.set_xticks(at[::every], numbers[::every])
    axes.set_xlim(-0.8, len(errors) - 0.2)
    axes.set_ylim(0, top)
    axes.set_xlabel("number of the picture")
    axes.set_ylabel("error [px]")
    axes.grid(axis="y", color=GRID, lw=0.6)
    axes.tick_params(axis="x", length=0)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.legend(
        loc="upper left", ncols=4, labelcolor=SOFT, frameon=True, facecolor=CARD,
        edgecolor="none", framealpha=1,
    )  # fmt: skip
    out = f", {len(calibration.rejected)} left out" if calibration.rejected else ""
    axes.set_title(f"Error of each view{out}")


def _draw_distortion(axes: Axes, camera: Camera) -> None:
    """Displacement of pixels by the lens distortion."""
    across, down = np.meshgrid(
        np.linspace(0, camera.width - 1, 97), np.linspace(0, camera.height - 1, 73)
    )
    pixels = np.stack([across, down], -1)
    rays = camera.normalise(pixels.reshape(-1, 2))
    ideal = camera.pinhole().project(np.concatenate([rays, np.ones((len(rays), 1))], 1))
    shift = pixels - ideal.reshape(pixels.shape)
    size = np.linalg.norm(shift, axis=-1)
    largest = float(np.nanmax(size))
    levels = _levels(largest)
    shown = np.ma.masked_invalid(size)
    filled = axes.contourf(
        across, down, shown, levels=levels, alpha=0.75,
        cmap="Blues", norm=BoundaryNorm(levels, matplotlib.colormaps["Blues"].N),
    )  # fmt: skip
    lines = axes.contour(across, down, shown, levels=levels[1:], colors=SOFT, linewidths=0.6)
    axes.clabel(lines, fmt="%g", fontsize=8, colors=INK)
    every = (slice(4, None, 12), slice(4, None, 11))
    _arrows(axes, camera, pixels[every], shift[every])
    bar = axes.figure.colorbar(filled, ax=axes, pad=0.01, fraction=0.035, ticks=levels[:-1])
    bar.set_label("px")
    bar.outline.set_visible(False)
    axes.plot(camera.cx, camera.cy, "+", ms=13, mew=1.6, color=BAD)
    kind = "fisheye" if camera.distortion is Distortion.EQUIDISTANT else "lens"
    axes.set_title(f"How far the {kind} moves what it shows; +: principal point")
    _frame(axes, camera)


def _arrows(axes: Axes, camera: Camera, at: Array, shift: Array) -> None:
    """Arrows of limited length for directions; colours show the length."""
    size = np.linalg.norm(shift, axis=-1, keepdims=True)
    longest = float(np.nanpercentile(size, 90))
    length = 0.05 * camera.width * np.minimum(size / max(longest, 1e-9), 1.0)
    drawn = shift / np.maximum(size, 1e-12) * length
    axes.quiver(
        at[..., 0], at[..., 1], drawn[..., 0], drawn[..., 1], angles="xy", scale_units="xy",
        scale=1, color=INK, width=0.0022, headwidth=4, pivot="tail",
    )  # fmt: skip


def _levels(largest: float) -> Array:
    """Round contour levels; closer together where all would lie at the border."""
    if largest > 400:  # a fisheye: without its distortion the rim would be far outside
        steps = np.array([1.0, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10000])
        top = float(steps[np.searchsorted(steps, min(largest, steps[-2])) + 1])
        return np.concatenate([[0.0], steps[steps < largest], [top]])
    step = _round(max(largest, 1e-3) / 7)
    return np.asarray(np.arange(0, largest + step, step), np.float64)


def _round(value: float) -> float:
    """Largest 1, 2 or 5 times a power of ten that is not above."""
    unit = 10.0 ** np.floor(np.log10(value))
    return float(max(m for m in (1, 2, 5) if m * unit <= value * 1.0001) * unit)


def _frame(axes: Axes, camera: Camera) -> None:
    axes.set_xlim(-0.5, camera.width - 0.5)
    axes.set_ylim(camera.height - 0.5, -0.5)
    axes.set_aspect("equal", adjustable="box")
    axes.tick_params(length=3)
