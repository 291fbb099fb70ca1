"""Default layout of the viewer."""

from __future__ import annotations

import rerun.blueprint as rrb
from rerun.blueprint.encodings import TextLogColumn, TimelineColumn

from companion.streaming.status_facts import CURVES

TIMELINE = "flight"
PLOTS = {
    "Flying": ("height", "speed", *CURVES.values()), "Quality": ("quality", "cpu"),
    "Poses": ("rate", "latency"), "Link": ("link",),
}  # fmt: skip
"""Units are in the names of the series; see `drawing`."""
LIVE_ONLY = ("Link",)
RANGES = {"Quality": (0.0, 105.0), "Poses": (0.0, 120.0)}
"""Plots of a fixed range, so that small changes look small."""
PLOTTED_S = 120.0
BACKGROUND = [20, 22, 26]
ZOOM = 17.0
"""Zoom of the map of the earth: about a metre per pixel of the screen."""


def layout(*, live: bool) -> rrb.Blueprint:
    """Map on the left; camera and depth beside it; status and the map of the earth on the right.

    Plots are below, of the last while if live, and the log.
    """
    plots = {title: names for title, names in PLOTS.items() if live or title not in LIVE_ONLY}
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                rrb.Spatial3DView(
                    origin="world",
                    name="Map (path: ours orange, the autopilot's blue; near things red to yellow)",
                    contents=["+ $origin/**", "- /world/map/sparse"],
                    background=BACKGROUND,
                    line_grid=False,
                    eye_controls=rrb.EyeControls3D(eye_up=(0.0, 0.0, -1.0)),
                ),
                rrb.Vertical(
                    rrb.Spatial2DView(origin="world/camera/image", name="Camera"),
                    rrb.Spatial2DView(origin="depth", name="Depth (near is red)"),
                    row_shares=[1, 1],
                ),
                rrb.Vertical(
                    rrb.TextDocumentView(origin="status", name="Status"),
                    rrb.MapView(origin="earth", name="On the earth", zoom=ZOOM),
                    row_shares=[3, 2],
                ),
                column_shares=[6, 3, 3],
            ),
            rrb.Horizontal(
                *(_plot(title, names, live) for title, names in plots.items()),
                rrb.TextLogView(origin="log", name="Log", columns=_log_columns()),
                column_shares=[4] * len(plots) + [10],
            ),
            row_shares=[7, 2],
        ),
        rrb.TimePanel(
            state="collapsed", timeline=TIMELINE, play_state="following" if live else None
        ),
        collapse_panels=True,
    )


def _plot(title: str, names: tuple[str, ...], live: bool) -> rrb.TimeSeriesView:
    last = rrb.VisibleTimeRange(
        TIMELINE,
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-PLOTTED_S),
        end=rrb.TimeRangeBoundary.cursor_relative(seconds=0.0),
    )
    return rrb.TimeSeriesView(
        origin="plots",
        contents=[f"+ $origin/{name}" for name in names],
        name=title,
        axis_y=rrb.ScalarAxis(range=RANGES[title]) if title in RANGES else None,
        plot_legend=rrb.PlotLegend(corner="LeftTop"),
        time_ranges=last if live else None,
    )


def _log_columns() -> rrb.TextLogColumns:
    return rrb.TextLogColumns(
        timeline_columns=[TimelineColumn(TIMELINE, visible=False)],
        text_log_columns=[TextLogColumn("loglevel"), TextLogColumn("body")],
    )
