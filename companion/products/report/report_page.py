"""HTML page of the report, self-contained."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime, timezone
from typing import Any

import numpy as np
from markupsafe import Markup

from companion.geometry.transforms import Array
from companion.messages.run_facts import RunFacts
from companion.products.cloud import Cloud
from companion.products.flight_result import FlightResult, WorldPose
from companion.products.report import plots
from companion.products.report.cloud_scene import PlacedKeyframe, cloud_scene
from companion.products.report.cloud_views import (
    OBLIQUE_DOWN_RAD,
    CloudView,
    cloud_views,
    oblique_heading_rad,
)
from companion.products.report.templates import rendered
from companion.telemetry import belief_in_words

N_DEPTH_PICTURES = 6
LAST_CENTURY_NS = 946_684_800 * 10**9
"""Times before 2000 are of a clock that was never set, and are no dates."""


def report_page(
    result: FlightResult,
    facts: RunFacts,
    poses: Sequence[WorldPose],
    cloud: Cloud,
    numbers: dict[str, Any],
) -> bytes:
    """HTML with all styles and pictures embedded; `numbers` are those of report.json."""
    segments = path_segments(poses)
    flown = [places for _, places in segments]
    # numpy, which draws the views, holds up no other thread: plots and page are made meanwhile
    with ThreadPoolExecutor(1, "views") as beside:
        views = beside.submit(cloud_views, cloud, flown)
        drawn = _plots(result, facts, segments, numbers["duration_s"])
        scene = None
        if len(cloud):
            view = oblique_heading_rad(cloud, flown), OBLIQUE_DOWN_RAD
            scene = cloud_scene(cloud, flown, _keyframes(result), view, result.unit, facts.origin)
    return rendered(
        "report.html.j2",
        distance,
        thousands,
        number,
        n=numbers,
        when=when(result.first_t_ns),
        plots=drawn,
        autopilot=_autopilot_name(result),
        belief=belief_in_words(facts.believed),
        scene=scene,
        views=[_view(view) for view in views.result()],
        depths=_depths(result),
        stages=plots.slowest_first({**numbers["stages"], **kernel_stages(result)}),
        config=json.dumps(numbers["config"], indent=2, ensure_ascii=False),
    )


def kernel_stages(result: FlightResult) -> dict[str, dict[str, float]]:
    """Times of the kernels, named for the table of stages."""
    return {f"{name} (kernel)": times for name, times in result.kernel_times().items()}


def path_segments(poses: Sequence[WorldPose]) -> list[tuple[Array, Array]]:
    """Parts of the path without gaps: t_ns (N,) and positions (N, 3) in the world.

    A gap is longer than five times the median step, and half a second at least.
    """
    if not poses:
        return []
    t_ns = np.array([pose.t_ns for pose in poses], np.int64)
    places = np.stack([pose.world_from_camera.translation for pose in poses])
    steps = np.diff(t_ns)
    gap_ns = max(5 * float(np.median(steps)), 5e8) if len(steps) else 5e8
    cuts = np.flatnonzero(steps > gap_ns) + 1
    return list(zip(np.split(t_ns, cuts), np.split(places, cuts), strict=True))


def when(t_ns: int | None) -> str | None:
    """Date and time of day, UTC; None where the clock was never set."""
    if t_ns is None or t_ns < LAST_CENTURY_NS:
        return None
    moment = datetime.fromtimestamp(t_ns // 10**9, tz=timezone.utc)
    return f"{moment.day} {moment:%B %Y, %H:%M:%S} UTC"


def distance(value: float, unit: str = "m") -> str:
    """A length to three digits or so.

    >>> distance(0.0342), distance(7.26), distance(1234.5)
    ('0.034 m', '7.26 m', '1,234 m')
    """
    return f"{number(value)} {unit}"


def number(value: float) -> str:
    """A number with as few digits as it can be read by."""
    if value == 0:
        return "0"
    digits = int(np.clip(2 - np.floor(np.log10(abs(value))), 0, 3))
    return f"{value:,.{digits}f}"


def thousands(value: int) -> str:
    """A count in thousands, with commas."""
    return f"{value:,}"


def _plots(
    result: FlightResult,
    facts: RunFacts,
    segments: Sequence[tuple[Array, Array]],
    duration_s: float,
) -> dict[str, Markup | None]:
    """The plots that have data; they are markup of our own making."""
    first = result.first_t_ns or 0
    found = result.autopilot_path()
    autopilot = None
    placed = result.georeference is not None and result.georeference.has_origin
    if found is not None and (placed or not segments):
        _, t_ns, position = found
        during = (t_ns >= first) & (t_ns <= (result.last_t_ns or first))
        if during.any():
            autopilot = ((t_ns[during] - first) * 1e-9, position[during])
    unit = "m" if autopilot is not None else result.unit
    flown = [((t_ns - first) * 1e-9, position) for t_ns, position in segments]
    some_path = bool(segments) or autopilot is not None
    stages = {**facts.stage_times, **kernel_stages(result)}
    drawn = {
        "plan": plots.plan_svg([p for _, p in flown], autopilot[1] if autopilot else None, unit)
        if some_path
        else None,
        "height": plots.height_svg(flown, autopilot, unit, duration_s) if some_path else None,
        "tracking": plots.tracking_svg(result.tracks, duration_s) if result.tracks else None,
        "stages": plots.stages_svg(stages) if stages else None,
    }
    return {name: None if svg is None else Markup(svg) for name, svg in drawn.items()}


def _autopilot_name(result: FlightResult) -> str | None:
    found = result.autopilot_path()
    return found[0].value if found is not None else None


def _keyframes(result: FlightResult) -> list[PlacedKeyframe]:
    first = result.first_t_ns or 0
    return [
        PlacedKeyframe(keyframe_id, None if t_ns is None else (t_ns - first) * 1e-9, pose)
        for keyframe_id, t_ns, pose in result.keyframes()
    ]


def _view(view: CloudView) -> dict[str, Any]:
    return {
        "title": view.title,
        "north_up": view.north_up,
        "src": _data("image/webp", view.webp),
        "width": view.width_px,
        "height": view.height_px,
        "paths": [" ".join(f"{u:.1f},{v:.1f}" for u, v in _sparse(path)) for path in view.paths],
        "bar": view.bar,
        "bar_share": 100 * view.bar_px / view.width_px,
    }


def _depths(result: FlightResult) -> list[dict[str, Any]]:
    """Depth pictures; ranges in metres where the keyframe's unit is known in metres."""
    out = []
    for picture in result.depth_pictures(N_DEPTH_PICTURES):
        place = result.update.place_of(picture.keyframe_id) if result.update is not None else None
        scale, unit = (1.0, "units") if place is None else (place.scale, "map units")
        if place is not None and result.georeference is not None:
            scale, unit = place.scale * result.georeference.world_from_map.scale, "m"
        out.append(
            {
                "image": _data("image/jpeg", picture.image_jpeg),
                "depth": _data("image/png", picture.depth_png()),
                "t_s": (picture.t_ns - (result.first_t_ns or 0)) * 1e-9,
                "near": picture.near * scale,
                "far": picture.far * scale,
                "unit": unit,
                "share": picture.share_known,
                "updates": picture.n_updates,
            }
        )
    return out


def _sparse(path: Array) -> Array:
    """At most a thousand points of a path."""
    kept: Array = path[np.unique(np.linspace(0, len(path) - 1, 1000).round().astype(int))]
    return kept


def _data(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"
