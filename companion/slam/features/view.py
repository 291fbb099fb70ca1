"""The frame being tracked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.geometry.transforms import Array, Pose
from companion.messages import Bytes
from companion.slam.features.orb_features import Features, Ints


@dataclass(slots=True, eq=False)
class View:
    """The frame being tracked: features, pose, and the map point of each feature (-1: none)."""

    seq: int
    t_ns: int
    features: Features
    ned_from_camera: Array | None
    grey: Bytes
    camera_from_map: Pose
    point_ids: Ints
    n_matches: int = 0
    map_from_camera_rotation: Array | None = None
    """Rotation (3, 3) by the autopilot, in the axes of the current map."""
    normalised: Array | None = None
    whitening: Array | None = None
    refined_for: Ints | None = None
    """(N,) as of a keyframe; None until the frame is tracked."""
    information: Array | None = None
    """Information (6, 6) of the pose: rotation, translation in the camera frame."""

    @property
    def centre(self) -> Array:
        """Position of the camera in the map (3,)."""
        out: Array = -self.camera_from_map.rotation.T @ self.camera_from_map.translation
        return out

    @property
    def n_inliers(self) -> int:
        """Features that observe a map point."""
        return int(np.count_nonzero(self.point_ids >= 0))

    @property
    def level_from_camera(self) -> Array | None:
        """Rotation to a gravity-aligned frame, where the attitude is measured."""
        by_map = self.map_from_camera_rotation
        return self.ned_from_camera if by_map is None else by_map
