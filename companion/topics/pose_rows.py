"""Poses and similarities as rows of numbers, and back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.errors import StreamError
from companion.geometry.transforms import (
    Array,
    Pose,
    Similarity,
    quaternion_from_rotation,
    rotation_from_quaternion,
)

POSE_NUMBERS = 7
"""x y z, then the quaternion w x y z; all nan without a pose."""
PLACE_NUMBERS = 8
"""A scale, then a pose."""
FURTHEST = 1e7
LEAST_NORM = 1e-3
LEAST_SCALE, MOST_SCALE = 1e-9, 1e9


def pose_row(pose: Pose | None) -> list[float]:
    """Seven numbers of a pose."""
    if pose is None:
        return [float("nan")] * POSE_NUMBERS
    return [*map(float, pose.translation), *map(float, quaternion_from_rotation(pose.rotation))]


def pose_rows(poses: Sequence[Pose | None]) -> Array:
    """One row (N, 7) for each pose."""
    return np.array([pose_row(pose) for pose in poses], np.float64).reshape(-1, POSE_NUMBERS)


def pose_of(row: NDArray[Any] | Sequence[float]) -> Pose | None:
    """Pose of seven numbers; None where they are nan. StreamError if invalid."""
    numbers = np.asarray(row, np.float64)
    if np.isnan(numbers).all():
        return None
    if not np.isfinite(numbers).all() or np.abs(numbers).max() > FURTHEST:
        raise StreamError("a pose that is not finite")
    if not LEAST_NORM < np.linalg.norm(numbers[3:]) < 1 / LEAST_NORM:
        raise StreamError("a quaternion of no length")
    return Pose(rotation_from_quaternion(numbers[3:]), numbers[:3].copy())


def known_pose_of(row: NDArray[Any] | Sequence[float]) -> Pose:
    """The same, where a pose is required."""
    pose = pose_of(row)
    if pose is None:
        raise StreamError("a pose is missing")
    return pose


def place_row(place: Similarity) -> list[float]:
    """Eight numbers of a similarity."""
    return [float(place.scale), *pose_row(Pose(place.rotation, place.translation))]


def place_of(row: NDArray[Any] | Sequence[float]) -> Similarity:
    """Similarity of eight numbers; StreamError if invalid."""
    scale, pose = float(row[0]), known_pose_of(row[1:])
    if not LEAST_SCALE < scale < MOST_SCALE:
        raise StreamError("a scale out of range")
    return Similarity(scale, pose.rotation, pose.translation)
