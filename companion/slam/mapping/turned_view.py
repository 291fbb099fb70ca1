"""Points of a view that a turn on the spot has brought: they are placed on level ground.

New ground that is seen without parallax cannot be triangulated, and soon nothing of the map is left
in view. Where the autopilot's attitude says which way is down, features that see the ground are
placed on the level through the points known so far. A depth that is off by a share of itself puts
the camera off by that share of its way since, which on the spot is little. Once the camera moves on
bundle adjustment has the parallax.
"""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Array, Pose, vector_from_rotation
from companion.slam.features.orb_features import Ints

MIN_TURN_RAD, MAX_TURN_PARALLAX_DEG = np.radians(10.0), 1.5
"""From one keyframe to the next on the spot: a fifth of a usual view, and half of the parallax that
makes a keyframe on the way."""
MIN_SEEN = 0.25
"""Share of a view's features that are points of the map: usual are 0.4 to 0.6, in a turn soon none.
"""
MIN_DIP = np.sin(np.radians(15.0))
"""Sine of the angle below the horizon: at less, a metre of relief moves a point by four."""
MIN_KNOWN = 20
"""Points that tell where the ground is."""
MAX_RELIEF = 0.25
"""Share of the camera's height by which their heights may scatter (half of them)."""


def median_parallax_deg(points: Array, here: Pose, there: Pose) -> float:
    """Median of the angles at `points` (N, 3) between two cameras, given as camera_from_map."""
    a, b = (-pose.rotation.T @ pose.translation - points for pose in (here, there))
    cosine = (a * b).sum(1) / np.maximum(
        np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1), 1e-12
    )
    return float(np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1))))


def is_turn(parallax_deg: float, here: Pose, there: Pose) -> bool:
    """True where two cameras differ by a turn, and by little else."""
    turn_rad = np.linalg.norm(vector_from_rotation(here.rotation @ there.rotation.T))
    return bool(parallax_deg < MAX_TURN_PARALLAX_DEG and turn_rad > MIN_TURN_RAD)


def on_level_ground(
    points_camera: Array, down_camera: Array, normalised: Array
) -> tuple[Ints, Array]:
    """Features that see level ground, and their places (M, 3) there, in camera axes.

    `points_camera` (N, 3) are known points, `down_camera` (3,) is the unit vector that points
    down, and `normalised` (F, 2) are the features. None of them where no ground is known.
    """
    none = np.zeros(0, np.int64), np.zeros((0, 3))
    if len(points_camera) < MIN_KNOWN:
        return none
    below = points_camera @ down_camera
    low, height, high = np.percentile(below, (25.0, 50.0, 75.0))
    if high - low >= MAX_RELIEF * height:  # also where it is above the camera
        return none
    rays = np.column_stack((normalised, np.ones(len(normalised))))
    falls = rays @ down_camera
    seen = np.flatnonzero(falls > MIN_DIP * np.linalg.norm(rays, axis=1))
    return seen, rays[seen] * (height / falls[seen])[:, None]
