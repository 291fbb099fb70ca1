"""Images of a rolling shutter, rendered row by row along a path with exact times."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from companion.geometry.camera import Camera
from companion.geometry.transforms import Pose
from companion.messages import Bytes
from tests.support.flights.scene import PlaneWorld

ROWS_AT_ONCE = 6
"""At 25 ms and 150 degrees/s they differ by a quarter of a pixel in an image of 180 rows."""


def rolled(
    world: PlaneWorld, camera: Camera, pose_at: Callable[[float], Pose], readout_s: float
) -> Bytes:
    """Grey image whose rows are seen from `world_from_camera` at their times about the stamp, s.

    Bands of a few rows share the time of their middle.
    """
    bands = []
    for first in range(0, camera.height, ROWS_AT_ONCE):
        n_rows = min(ROWS_AT_ONCE, camera.height - first)
        middle = first + 0.5 * (n_rows - 1)
        t_s = (middle / (camera.height - 1) - 0.5) * readout_s
        band = replace(camera, height=n_rows, cy=camera.cy - first)
        bands.append(world.render(band, pose_at(t_s))[0])
    return np.concatenate(bands)
