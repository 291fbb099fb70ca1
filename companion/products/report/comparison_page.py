"""HTML page of a comparison, self-contained."""

from __future__ import annotations

import io
from typing import Any

import matplotlib
import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from companion.geometry.transforms import Array
from companion.products.report.comparison import Comparison, numbers
from companion.products.report.templates import rendered

A, B, DIFFERENCE = "#9aa0a6", "#0b6bcb", "#d64545"
STYLE: Any = {
    "svg.fonttype": "none", "svg.hashsalt": "comparison", "font.size": 10.0,
    "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True,
    "grid.color": "#dddbd6", "grid.linewidth": 0.6, "axes.axisbelow": True,
    "legend.frameon": False,
}  # fmt: skip
MAX_POINTS = 3000


def comparison_page(found: Comparison, name_a: str, name_b: str) -> bytes:
    """HTML with all styles and plots embedded."""
    with matplotlib.rc_context(STYLE):
        return rendered(
            "comparison.html.j2", shown,
            n=numbers(found), a=name_a, b=name_b, stages=found.stages,
            path=_path(found), cloud=_cloud(found),
        )  # fmt: skip


def shown(value: Any) -> str:
    """A number with few digits; a dash for none."""
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _path(found: Comparison) -> Markup | None:
    poses = found.poses
    if not len(poses.t_ns):
        return None
    step = -(-len(poses.t_ns) // MAX_POINTS)
    figure = Figure(figsize=(11, 4.4), layout="constrained")
    plan, distance = figure.subplots(1, 2)
    for centres, colour, width, name in (
        (poses.centres_a, A, 3.5, "A"),
        (poses.centres_b, B, 1.2, "B"),
    ):
        plan.plot(centres[::step, 1], centres[::step, 0], color=colour, lw=width, label=name)
    plan.set_aspect("equal", adjustable="datalim")
    plan.set_xlabel(f"east [{found.unit}]")
    plan.set_ylabel(f"north [{found.unit}]")
    plan.legend()
    seconds = (poses.t_ns - poses.t_ns[0])[::step] * 1e-9
    distance.plot(seconds, poses.distance_m[::step], color=DIFFERENCE, lw=1)
    distance.set_xlabel("time [s]")
    distance.set_ylabel(f"A and B apart [{found.unit}]")
    distance.set_ylim(bottom=0)
    rotation = distance.twinx()
    rotation.plot(seconds, poses.rotation_deg[::step], color=A, lw=1)
    rotation.set_ylabel("turned [deg], grey")
    rotation.set_ylim(bottom=0)
    rotation.grid(False)
    return figure_svg(figure)


def _cloud(found: Comparison) -> Markup | None:
    if not len(found.cloud.from_a_m) or found.same_files["cloud.ply"]:
        return None
    figure = Figure(figsize=(11, 3.2), layout="constrained")
    axes = figure.add_subplot()
    for values, colour, name in (
        (found.cloud.from_a_m, A, "from A to B"),
        (found.cloud.from_b_m, B, "from B to A"),
    ):
        axes.plot(*_shares(values), color=colour, label=name)
    axes.set_xlabel(f"distance to the nearest point of the other [{found.unit}]")
    axes.set_ylabel("share of points")
    axes.set_xlim(left=0)
    axes.legend(loc="lower right")
    return figure_svg(figure)


def _shares(values: Array) -> tuple[Array, Array]:
    shares = np.linspace(0, 0.995, 200)
    return np.quantile(values, shares), shares


def figure_svg(figure: Figure) -> Markup:
    """A figure as SVG within a page."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    return Markup(text[text.index("<svg") :])
