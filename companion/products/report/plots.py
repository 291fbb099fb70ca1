"""Plots of the report, as SVG that takes colours and type from the page."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from companion.geometry.transforms import Array
from companion.messages import Track, TrackState

# Stand-ins that no other colour comes near to; the page's style gives each its colour.
INK, SOFT, GRID = "#010203", "#040506", "#070809"
PATH, OTHER, BAD, IDLE = "#0a0b0c", "#0d0e0f", "#101112", "#131415"
VARIABLES = {
    INK: "--ink", SOFT: "--soft", GRID: "--grid",
    PATH: "--path", OTHER: "--other", BAD: "--bad", IDLE: "--idle",
}  # fmt: skip
STYLE = {
    "svg.fonttype": "none",
    "font.size": 10.0,
    "axes.edgecolor": GRID,
    "axes.labelcolor": SOFT,
    "xtick.color": GRID,
    "ytick.color": GRID,
    "xtick.labelcolor": SOFT,
    "ytick.labelcolor": SOFT,
    "text.color": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "legend.frameon": False,
}
MAX_POINTS = 3000
AUTOPILOT: Any = {"color": OTHER, "lw": 4, "alpha": 0.55, "label": "autopilot"}
"""Broad line, since the camera's path often lies right on it."""
MIN_HEIGHT_M = 4.0
"""Least range of a height plot."""
MIN_HALF = 0.5
"""Half the least extent of a plan: a camera that stood still is a point with a margin."""


def plan_svg(segments: Sequence[Array], autopilot: Array | None, unit: str) -> str:
    """Plan view of the path, north up and east right; positions (N, 3) north, east, down."""
    everything = [*segments, *([autopilot] if autopilot is not None else [])]
    with _style("plan"):
        low, high = _bounds(everything)
        middle, half = (low + high) / 2, np.maximum(0.53 * (high - low), MIN_HALF)
        half[:2] = np.maximum(half[:2], [0.45 * half[1], 0.8 * half[0]])  # no slivers
        tall = float(np.clip(half[0] / half[1], 0.45, 1.1))
        figure = Figure(figsize=(6.4, 5.6 * tall + 0.8), layout="constrained")
        axes = figure.add_subplot()
        if autopilot is not None:
            axes.plot(*_thin(autopilot)[:, 1::-1].T, **AUTOPILOT)
        _draw_segments(axes, [segment[:, 1::-1] for segment in segments])
        if segments:
            first, last = segments[0][0], segments[-1][-1]
            axes.plot(first[1], first[0], "o", ms=8, mfc="none", mec=PATH, label="start")
            axes.plot(last[1], last[0], "s", ms=6, color=PATH, label="end")
        metric = unit == "m"
        axes.set_xlabel("east [m]" if metric else f"y [{unit}]")
        axes.set_ylabel("north [m]" if metric else f"x [{unit}]")
        axes.set_aspect("equal", adjustable="box")
        axes.set_xlim(middle[1] - half[1], middle[1] + half[1])
        axes.set_ylim(middle[0] - half[0], middle[0] + half[0])
        _legend(axes)
        return _svg(figure)


def height_svg(
    segments: Sequence[tuple[Array, Array]],
    autopilot: tuple[Array, Array] | None,
    unit: str,
    duration_s: float,
) -> str:
    """Height over time, of pairs of seconds (N,) and positions (N, 3) north, east, down."""
    with _style("height"):
        figure = Figure(figsize=(6.4, 2.9), layout="constrained")
        axes = figure.add_subplot()
        if autopilot is not None:
            t_s, position = autopilot
            line = _thin(np.stack([t_s, -position[:, 2]], 1))
            axes.plot(*line.T, **AUTOPILOT)
        _draw_segments(axes, [np.stack([t, -p[:, 2]], 1) for t, p in segments])
        axes.set_ylabel("height [m]" if unit == "m" else f"-z [{unit}]")
        low, high = axes.get_ylim()
        if unit == "m" and high - low < MIN_HEIGHT_M:  # else centimetres look like mountains
            middle = (low + high) / 2
            axes.set_ylim(middle - MIN_HEIGHT_M / 2, middle + MIN_HEIGHT_M / 2)
        _time_axis(axes, duration_s)
        _legend(axes)
        return _svg(figure)


def tracking_svg(tracks: Sequence[Track], duration_s: float) -> str:
    """Map points found in each frame, over bands where the pose was unknown."""
    with _style("tracking"):
        figure = Figure(figsize=(11.6, 2.6), layout="constrained")
        axes = figure.add_subplot()
        t_s = np.array([(track.t_ns - tracks[0].t_ns) * 1e-9 for track in tracks])
        known = np.array([track.state is TrackState.TRACKING for track in tracks])
        found = np.where(known, [float(track.n_inliers) for track in tracks], np.nan)
        axes.plot(*_thin(np.stack([t_s, found], 1)).T, color=PATH, lw=1.2, label="map points found")
        for state, colour in (
            (TrackState.INITIALISING, IDLE),
            (TrackState.DEAD_RECKONING, OTHER),
            (TrackState.LOST, BAD),
        ):  # fmt: skip
            here = np.array([track.state is state for track in tracks])
            axes.fill_between(
                _edges(t_s), 0, 1, where=np.append(here, False), step="post",
                transform=axes.get_xaxis_transform(), color=colour, alpha=0.35, lw=0,
                label=state.value if here.any() else "_",
            )  # fmt: skip
        axes.set_ylim(0, 1.08 * max(float(np.nanmax(found, initial=0.0)), 1.0))
        axes.set_ylabel("points")
        axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
        _time_axis(axes, duration_s)
        _legend(axes)
        return _svg(figure)


def slowest_first(
    stage_times: Mapping[str, Mapping[str, float]],
) -> list[tuple[str, Mapping[str, float]]]:
    """Stages with their times, in the order of their total."""
    return sorted(stage_times.items(), key=lambda stage: -stage[1]["total_s"])


def stages_svg(stage_times: Mapping[str, Mapping[str, float]]) -> str:
    """Milliseconds per call of each stage: bars to the median, lines to the 95th percentile."""
    with _style("stages"):
        names = [name for name, _ in slowest_first(stage_times)]
        figure = Figure(figsize=(6.4, 0.32 * len(names) + 0.9), layout="constrained")
        axes = figure.add_subplot()
        rows = np.arange(len(names))
        p50 = np.array([stage_times[name]["p50_ms"] for name in names])
        p95 = np.array([stage_times[name]["p95_ms"] for name in names])
        axes.barh(rows, p50, height=0.55, color=PATH, label="median")
        axes.hlines(rows, p50, p95, color=OTHER, lw=2, label="to the 95th percentile")
        axes.set_yticks(rows, names)
        axes.tick_params(axis="y", length=0, labelcolor=INK)
        axes.grid(visible=False, axis="y")
        axes.invert_yaxis()
        if (p50 > 0).all() and p95.max() > 30 * p50.min():
            axes.set_xscale("log")
            axes.xaxis.set_major_formatter("{x:g}")
        axes.set_xlabel("ms")
        _legend(axes)
        return _svg(figure)


def _style(name: str) -> AbstractContextManager[None]:
    """Style of the report; the plot's name keeps its element ids unique."""
    style: Any = {**STYLE, "svg.hashsalt": name}
    return matplotlib.rc_context(style)


def _draw_segments(axes: Axes, lines: Sequence[Array]) -> None:
    for n, line in enumerate(lines):
        axes.plot(*_thin(line).T, color=PATH, lw=1.8, label="camera" if n == 0 else "_")


def _thin(line: Array) -> Array:
    """At most `MAX_POINTS` points of a line, its ends included."""
    if len(line) <= MAX_POINTS:
        return line
    thinned: Array = line[np.linspace(0, len(line) - 1, MAX_POINTS).round().astype(int)]
    return thinned


def _bounds(parts: Sequence[Array]) -> tuple[Array, Array]:
    every = np.concatenate(parts) if parts else np.zeros((1, 3))
    return every.min(0), every.max(0)


def _edges(t_s: Array) -> Array:
    """Time of each frame, and the end of the last one."""
    step = float(np.median(np.diff(t_s))) if len(t_s) > 1 else 0.05
    return np.append(t_s, t_s[-1] + step)


def _time_axis(axes: Axes, duration_s: float) -> None:
    axes.set_xlabel("time [s]")
    axes.set_xlim(0, max(duration_s, 1e-3))


def _legend(axes: Axes) -> None:
    if axes.get_legend_handles_labels()[0]:
        axes.legend(
            loc="lower left", bbox_to_anchor=(0, 1), ncols=5, borderaxespad=0, labelcolor=SOFT
        )


def _svg(figure: Figure) -> str:
    """The figure as an element to embed in a page, the same bytes each time."""
    figure.patch.set_alpha(0)
    for axes in figure.axes:
        axes.patch.set_alpha(0)
    out = io.StringIO()
    # `savefig` draws once more before it, for the size of a figure that is to be cut to it
    FigureCanvasSVG(figure).print_svg(  # type: ignore[no-untyped-call]
        out, metadata={"Date": None, "Creator": None}
    )
    svg = out.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r' (?:width|height)="[\d.]+pt"', "", svg, count=2)
    for colour, variable in VARIABLES.items():
        svg = svg.replace(colour, f"var({variable})")
    return svg
