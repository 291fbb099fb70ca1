"""The layout that is good without a click."""

from __future__ import annotations

import rerun.blueprint as rrb


def layout() -> rrb.Blueprint:
    """Map on the left; image, depth and log on the right; plots below."""
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                rrb.Spatial3DView(
                    origin="world",
                    name="Map",
                    contents=["+ $origin/**", "- /world/map/sparse"],
                    background=[20, 22, 26],
                    line_grid=False,
                    eye_controls=rrb.EyeControls3D(eye_up=(0.0, 0.0, -1.0)),
                ),
                rrb.Vertical(
                    rrb.Spatial2DView(origin="world/camera/image", name="Camera"),
                    rrb.Spatial2DView(origin="depth", name="Depth of the newest keyframe"),
                    rrb.TextLogView(origin="log", name="Log"),
                    row_shares=[4, 4, 2],
                ),
                column_shares=[7, 3],
            ),
            rrb.Horizontal(
                rrb.TimeSeriesView(origin="plots/height", name="Height above origin (m, up)"),
                rrb.TimeSeriesView(origin="plots/speed", name="Speed (m/s)"),
                rrb.TimeSeriesView(origin="plots/points", name="Map points found in the image"),
                rrb.TimeSeriesView(
                    origin="plots/state", name="State (2 tracking, 1 initialising, 0 lost)"
                ),
                rrb.Tabs(
                    rrb.TimeSeriesView(origin="plots/kernels", name="Depth kernels (ms)"),
                    rrb.TimeSeriesView(origin="plots/scale", name="Metres per map unit"),
                ),
            ),
            row_shares=[4, 1],
        ),
        collapse_panels=True,
    )
