"""Keyframes to align with what was measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from companion.geometry.transforms import Array, Pose, nearest_rotation


@dataclass(frozen=True, slots=True, eq=False)
class AlignmentSample:
    """A keyframe to align: its pose in the map, and its measured attitude.

    `ground_units` is the distance from the body down its own axis to the mapped ground, map units,
    where mapped.
    """

    t_ns: int
    map_from_camera: Pose
    ned_from_camera: Array | None
    ground_units: float | None = None


def mean_rotation(samples: Sequence[AlignmentSample]) -> Array | None:
    """Chordal mean of world_from_map rotations by attitude; None without."""
    rotations = [
        p.ned_from_camera @ p.map_from_camera.rotation.T
        for p in samples
        if p.ned_from_camera is not None
    ]
    if not rotations:
        return None
    return nearest_rotation(np.sum(rotations, axis=0))
