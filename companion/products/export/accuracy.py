"""Accuracy statement of an export, from the numbers of the run's report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import Enum
from typing import Any

import numpy as np

from companion.products.export.map_frame import MapFrame
from companion.products.run_folder import FinishedRun

USUAL_M = 3.0
ABSOLUTE = (
    "Absolute position: no better than the autopilot's own. Without correction data that is 1 to "
    "3 m horizontally and about twice that in height (a satellite receiver's usual figures, not "
    "measured here); an error common to the whole flight shifts everything alike."
)


class Axes(Enum):
    """Coordinate frame of an export."""

    LOCAL = "local north, east, down in metres"
    FIRST_CAMERA = "right, down, forward of the first camera that was placed, in metres from it"
    EAST_NORTH_UP = "local east, north, up in metres"
    GLTF = "x east, y up, z south, in metres from the local zero"
    EARTH = "latitude and longitude in degrees, WGS84"
    EARTH_CENTRED = "Earth-centred, Earth-fixed metres (ECEF, WGS84), by the transform of the tile"
    MAP = "those of a map's frame"


def accuracy_statement(
    run: FinishedRun, file: str, axes: Axes | MapFrame, remarks: Sequence[str] = ()
) -> bytes:
    """Text beside an export; `axes` is the map frame of exports in map coordinates.

    `remarks` are lines about this kind of export.
    """
    report = run.report
    lines = [f"{file}: how it was placed, and how far that can be trusted", ""]
    lines += _placed(run, axes)
    lines += ["", *remarks, *_scale(run, report.get("scale"))]
    camera = report.get("camera") or {}
    if camera.get("assumed"):
        lines.append(
            "Camera: ASSUMED, not calibrated. Shapes can be bent and heights wrong by several per "
            "cent, beyond every figure given here."
        )
    clock = report.get("clock")
    if clock and clock.get("sigma_ms") is not None:
        lines.append(
            f"Clocks: autopilot and camera put together by {clock['method']}, "
            f"within {clock['sigma_ms']:.1f} ms (one standard deviation)."
        )
    lines.append(
        f"Path: {report.get('tracked', 0)} of {report.get('frames', 0)} frames placed. "
        + _times(run, clock)
    )
    lines.append("No ground control was used; nothing here was checked against surveyed points.")
    return ("\n".join(lines) + "\n").encode()


def remarks_on_heights(run: FinishedRun) -> list[str]:
    """Warnings of the run about its heights: they are then not above mean sea level."""
    return [f"{what}: {detail}" for what, detail in _warnings(run) if what.startswith("heights")]


def _warnings(run: FinishedRun) -> list[tuple[str, str]]:
    """Kinds of warning, with the first detail of each."""
    return [
        (str(warning.get("what")), str(warning.get("first_detail", "")))
        for warning in run.report.get("warnings") or []
        if isinstance(warning, dict)
    ]


def _times(run: FinishedRun, clock: Mapping[str, Any] | None) -> str:
    own = [detail for what, detail in _warnings(run) if what.startswith("no frames.csv")]
    if not own:
        return "Times are of the middle of the exposure, on the recording computer's clock."
    text = f"Times are the video's own, {own[0]}."
    if clock and str(clock.get("method")).startswith("rotation") and "offset_s" in clock:
        text += f" The log's are these less {clock['offset_s']:.3f} s."
    return text


def _placed(run: FinishedRun, axes: Axes | MapFrame) -> list[str]:
    coordinates = axes.name if isinstance(axes, MapFrame) else axes.value
    if not run.metric:
        return [
            "Unit: map units. No metric scale was found, so lengths are only in proportion, and "
            "axes and zero are arbitrary."
        ]
    if run.origin is None:
        return [
            f"Coordinates: {coordinates}.",
            "Frame: local, metres; zero at the first camera. No position was known, so neither "
            "place nor, but for the compass, heading are.",
        ]
    o = run.origin
    against = remarks_on_heights(run)
    level = "in heights that are not those above the sea" if against else "above mean sea level"
    zero = (
        f"Zero of the local frame: latitude {o.latitude_deg:.8f}, longitude "
        f"{o.longitude_deg:.8f} (WGS84), {o.altitude_m:.3f} m {level}."
    )
    if isinstance(axes, MapFrame):
        coordinates += f" (EPSG:{axes.epsg}); projected by PROJ from WGS84"
    lines = [f"Coordinates: {coordinates}."]
    if against:
        lines.append("Heights: NOT above mean sea level. " + "; ".join(against) + ".")
    elif axes in (Axes.EARTH, Axes.EARTH_CENTRED):
        lines.append(
            "Heights: above mean sea level as the autopilot gives them, not above the ellipsoid."
        )
    elif isinstance(axes, MapFrame):
        lines.append(
            "Heights: above mean sea level as the autopilot gives them, written as EGM96; no geoid "
            "model was applied."
        )
    return [*lines, zero, ABSOLUTE]


def _scale(run: FinishedRun, scale: Mapping[str, Any] | None) -> list[str]:
    if not run.metric or not scale:
        return []
    relative, yaw_deg = scale.get("sigma_relative"), scale.get("sigma_yaw_deg")
    lines = [f"Scale and heading: from {scale.get('method')}, {scale.get('positions', 0)} samples."]
    left_m = scale.get("residual_m")
    if left_m is not None:
        lines.append(f"Left between path and positions: {left_m:.2f} m.")
        if left_m > USUAL_M:
            lines.append(
                f"That is more than positions of satellites usually err: they disagree with what "
                f"the pictures show, and absolute position is no better than {left_m:.0f} m."
            )
    if relative is not None and yaw_deg is not None:
        reach = _reach_m(run)
        lines.append(
            f"Relative: scale within {100 * relative:.2f} %, heading within {yaw_deg:.2f} degrees "
            f"(one standard deviation); at {reach:.0f} m from the middle of the flight, its far "
            f"end, that is {reach * relative:.2f} m along and "
            f"{reach * float(np.radians(yaw_deg)):.2f} m across."
        )
    return lines


def _reach_m(run: FinishedRun) -> float:
    if not run.poses:
        return 0.0
    path = np.stack([pose.world_from_camera.translation[:2] for pose in run.poses])
    points = run.cloud.points[:, :2] if len(run.cloud) else path
    return float(np.linalg.norm(points - path.mean(0), axis=1).max())
