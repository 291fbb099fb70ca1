"""Prediction for a frame by motion and attitude, before its image is processed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.geometry.transforms import Array, Pose, angle_between

MAX_ROTATION_ERROR_RAD = np.radians(15.0)


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """Prediction for a frame, before its image is processed.

    `map_from_camera` predicted pose or None; `ned_from_camera` rotation by the autopilot or None,
    and `map_from_camera_rotation` the same in the axes of the map, which may be some degrees off
    level.
    """

    map_from_camera: Pose | None
    ned_from_camera: Array | None
    map_from_camera_rotation: Array | None = None

    def agrees(self, camera_from_map: Pose) -> bool:
        """True if the rotation of a pose agrees with the prediction by attitude, or none exists."""
        if self.map_from_camera is None or self.ned_from_camera is None:
            return True
        off_rad = angle_between(self.map_from_camera.rotation, camera_from_map.rotation.T)
        return off_rad < float(MAX_ROTATION_ERROR_RAD)
