"""A calibration board as a page to print, to scale."""

from __future__ import annotations

import io

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline

from companion.calibration.chart import Chart

PAPERS_MM = {
    "A4": (210, 297), "A3": (297, 420), "A2": (420, 594), "A1": (594, 841), "A0": (841, 1189),
}  # fmt: skip
LEAST_MARGIN_MM = 4.0
INCH_MM = 25.4
DOTS_PER_INCH, MOST_DOTS = 300, 8000
"""Resolution of a PNG; lower for a large board, so that the page fits into memory."""


def board_page(chart: Chart, form: str) -> tuple[bytes, str]:
    """The page as "png" or "pdf", and its paper size."""
    rectangles = chart.black_m() * 1000
    square_mm = chart.square_m * 1000
    across_mm, down_mm = (chart.columns + 1) * square_mm, (chart.rows + 1) * square_mm
    paper, width_mm, height_mm = _paper(across_mm, down_mm)
    left_mm, below_mm = (width_mm - across_mm) / 2, (height_mm - down_mm) / 2
    dots_per_inch = min(DOTS_PER_INCH, MOST_DOTS / max(width_mm, height_mm) * INCH_MM)
    with matplotlib.rc_context({"pdf.fonttype": 42}):
        figure = Figure(figsize=(width_mm / INCH_MM, height_mm / INCH_MM), dpi=dots_per_inch)
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set_axis_off()
        axes.set_xlim(-left_mm, width_mm - left_mm)
        axes.set_ylim(height_mm - below_mm, -below_mm)
        x, y, w, h = rectangles.T
        corners = np.stack(
            [np.stack(c, 1) for c in ((x, y), (x + w, y), (x + w, y + h), (x, y + h), (x, y))], 1
        )
        # one outline, so that no hair lines show between rectangles that touch
        codes = [Outline.MOVETO, *[Outline.LINETO] * 3, Outline.CLOSEPOLY] * len(corners)
        outline = Outline(corners.reshape(-1, 2), codes)
        black = PathPatch(outline, facecolor="black", edgecolor="none", linewidth=0)
        black.set_snap(False)  # whole dots would make squares of different sizes
        axes.add_patch(black)
        points = min(8.0, 0.55 * below_mm / INCH_MM * 72)
        axes.text(
            across_mm / 2, down_mm + below_mm * 0.6,
            f"{chart.name}     one square is {square_mm:g} mm: print at 100 %, measure, mount flat",
            ha="center", va="center", fontsize=points, color="0.35",
        )  # fmt: skip
        out = io.BytesIO()
        dates = {"CreationDate": None} if form == "pdf" else {"Software": None}
        figure.savefig(out, format=form, dpi=dots_per_inch, metadata=dates)
    return out.getvalue(), paper


def _paper(across_mm: float, down_mm: float) -> tuple[str, float, float]:
    """Smallest paper that holds the board, portrait or landscape; else a custom size."""
    for name, (short, long) in PAPERS_MM.items():
        for width, height in ((long, short), (short, long)):
            if min(width - across_mm, height - down_mm) >= 2 * LEAST_MARGIN_MM:
                return name, float(width), float(height)
    width_mm, height_mm = across_mm + 20, down_mm + 20
    return f"{width_mm:.0f} x {height_mm:.0f} mm", width_mm, height_mm
