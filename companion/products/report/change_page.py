"""HTML page of the changes between two site maps: a plan of them, and a row for each."""

from __future__ import annotations

from typing import Any

import matplotlib
from markupsafe import Markup
from matplotlib.figure import Figure

from companion.products.report.comparison_page import STYLE, figure_svg, shown
from companion.products.report.templates import rendered
from companion.products.site_changes import COLOURS
from companion.slam.mapping.site_change import SiteComparison


def change_page(found: SiteComparison, numbers: dict[str, Any], name_a: str, name_b: str) -> bytes:
    """HTML with all styles and plots embedded; `numbers` are those of the JSON beside it."""
    with matplotlib.rc_context(STYLE):
        return rendered("changes.html.j2", shown, n=numbers, a=name_a, b=name_b, plan=_plan(found))


def _plan(found: SiteComparison) -> Markup:
    figure = Figure(figsize=(11, 7), layout="constrained")
    axes = figure.add_subplot()
    for path_m, style, name in (
        (found.path_before_m, "-", "A"), (found.path_after_m, "--", "B")
    ):  # fmt: skip
        axes.plot(path_m[:, 1], path_m[:, 0], style, color="#9aa0a6", lw=1, label=f"path of {name}")
    named = set()
    for number, change in enumerate(found.changes, 1):
        colour = [c / 255 for c in COLOURS[change.kind]]
        label = "_" if change.kind in named else change.kind
        named.add(change.kind)
        north_m, east_m, _ = change.points_m.T
        axes.plot(east_m, north_m, ".", color=colour, ms=4, label=label)
        north, east, _ = change.centre_m
        axes.annotate(str(number), (east, north), xytext=(6, 6), textcoords="offset points")
        if change.moved_m is not None:
            end = change.centre_m + change.moved_m
            axes.annotate("", (end[1], end[0]), (east, north), arrowprops={
                "arrowstyle": "->", "color": colour,
            })  # fmt: skip
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("east [m]")
    axes.set_ylabel("north [m]")
    axes.legend()
    return figure_svg(figure)
