"""companion flights mission: the path that a flight took, or the way back, as a mission."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from companion.errors import FlightError, InputError
from companion.estimation.gate.global_gate import place_sigma_m
from companion.geometry.thinned_path import thinned
from companion.geometry.transforms import Array
from companion.products.atomic_file import write_atomically
from companion.products.mission_file import mission_plan, mission_waypoints
from companion.products.run_folder import read_path

WRITERS = {".plan": mission_plan, ".waypoints": mission_waypoints}
MAX_ITEMS = 700
"""ArduPilot keeps at least so many with its usual storage."""
LONG_GAP_M = 10.0
"""A straight line over a gap of the path that is worth a word."""


def mission(given: str, folder: Path, out: Path, within_m: float, back: bool) -> str:
    """Write the path of a flight, or the way back from its end; a line about it.

    `given` is the folder of a run or the name of a flight in `folder`. InputError where its path
    has no place on the globe, or where autopilots could not keep so many waypoints.
    """
    write = WRITERS.get(out.suffix)
    if write is None:
        raise InputError(f"{out}: wanted is a name that ends in {' or '.join(WRITERS)}")
    run = next((p for p in (Path(given), folder / given) if p.is_dir()), None)
    if run is None:
        raise FlightError(f"{given}: no folder of a run, and no flight of this name in {folder}")
    poses, origin, scale = read_path(run)
    if origin is None:
        raise InputError(f"{run}: no place on the globe is known of it, so it makes no mission")
    if len(poses) < 2:
        raise InputError(f"{run}: it has no path")
    path_m = np.stack([pose.world_from_camera.translation for pose in poses])
    steps_m = np.linalg.norm(np.diff(path_m, axis=0), axis=1)
    places = thinned(path_m[::-1] if back else path_m, within_m)
    if len(places) > MAX_ITEMS:
        raise InputError(
            f"{run}: {len(places)} waypoints, and autopilots keep {MAX_ITEMS}: give a greater "
            f"--within than {within_m:g}"
        )
    write_atomically(out, write(places, origin))
    gap = f"; a straight line of {steps_m.max():.0f} m where it had no pose" * bool(
        steps_m.max() > LONG_GAP_M
    )
    return (
        f"{out}: {len(places)} waypoints, {steps_m.sum():.0f} m{', back from its end' * back}, "
        f"within {within_m:g} m of the path{_placed(path_m, scale)}; heights above sea level, "
        f"{-path_m[:, 2].max():.1f} to {-path_m[:, 2].min():.1f} m above its origin{gap}"
    )


def _placed(path_m: Array, scale: Mapping[str, Any]) -> str:
    """Words on how well a path is placed on the globe, by the report's account of its scale."""
    numbers = [scale.get(key) for key in ("residual_m", "sigma_yaw_deg", "sigma_relative")]
    if not all(isinstance(number, int | float) for number in numbers):
        return ", placed how well is not known"
    residual_m, yaw_deg, relative = (float(number) for number in numbers if number is not None)
    reach_m = float(np.linalg.norm(path_m - path_m.mean(0), axis=1).max())
    sigma_m = place_sigma_m(reach_m, residual_m, float(np.radians(yaw_deg)), relative)
    return f", placed within {sigma_m:.1f} m (one standard deviation)"
