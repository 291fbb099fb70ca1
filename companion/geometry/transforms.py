"""Rotations, rigid poses and similarities: numpy only, pure.

Frames (all right-handed):

| name   | axes                                   | unit      |
|--------|----------------------------------------|-----------|
| world  | north, east, down (local NED)          | metres    |
| map    | like world once levelled; first camera at the origin | map units |
| body   | forward, right, down (FRD)             | metres    |
| camera | right, down, forward                   | map units |
| image  | u right, v down; pixel centres at integers | pixels |

A transform is named `a_from_b`: it takes coordinates in b to coordinates in a, so that names
meet in a product. Quaternions are Hamilton, ordered w x y z, with w >= 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """A rigid transform `a_from_b`: rotation (3, 3), translation (3,)."""

    rotation: Array
    translation: Array

    @staticmethod
    def identity() -> Pose:
        """The transform of a frame to itself."""
        return Pose(np.eye(3), np.zeros(3))

    @staticmethod
    def from_matrix(matrix: NDArray[Any]) -> Pose:
        """Build from a (3, 4) or (4, 4) matrix."""
        m = np.asarray(matrix, np.float64)
        return Pose(m[:3, :3].copy(), m[:3, 3].copy())

    def __matmul__(self, other: Pose) -> Pose:
        return Pose(
            self.rotation @ other.rotation, self.rotation @ other.translation + self.translation
        )

    def inverse(self) -> Pose:
        """Return `b_from_a`."""
        return Pose(self.rotation.T, -self.rotation.T @ self.translation)

    def apply(self, points: Array) -> Array:
        """Transform points (..., 3)."""
        moved: Array = points @ self.rotation.T + self.translation
        return moved

    def matrix(self) -> Array:
        """The (4, 4) matrix."""
        m = np.eye(4)
        m[:3, :3], m[:3, 3] = self.rotation, self.translation
        return m


@dataclass(frozen=True, slots=True, eq=False)
class Similarity:
    """A transform with scale: a = scale * rotation @ b + translation."""

    scale: float
    rotation: Array
    translation: Array

    @staticmethod
    def identity() -> Similarity:
        """The transform of a frame to itself."""
        return Similarity(1.0, np.eye(3), np.zeros(3))

    def apply(self, points: Array) -> Array:
        """Transform points (..., 3)."""
        moved: Array = self.scale * (points @ self.rotation.T) + self.translation
        return moved

    def __matmul__(self, other: Similarity) -> Similarity:
        return Similarity(
            self.scale * other.scale, self.rotation @ other.rotation, self.apply(other.translation)
        )

    def apply_to_pose(self, pose: Pose) -> Pose:
        """Return the pose in a of a frame given in b: position scaled, axes rotated."""
        return Pose(self.rotation @ pose.rotation, self.apply(pose.translation))

    def inverse(self) -> Similarity:
        """Return `b_from_a`."""
        r = self.rotation.T
        return Similarity(1.0 / self.scale, r, -(r @ self.translation) / self.scale)


_IDENTITY = np.eye(3)


def length(v: Array) -> float:
    """Norm of one vector, as `np.linalg.norm` has it, without what that asks about its argument."""
    return math.sqrt(v.dot(v))


def skew(v: Array) -> Array:
    """Cross-product matrices (..., 3, 3) of vectors (..., 3)."""
    v = np.asarray(v, np.float64)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def nearest_rotation(matrix: Array) -> Array:
    """The nearest rotation to a matrix (3, 3), to remove accumulated rounding errors."""
    u, _, vt = np.linalg.svd(matrix)
    out: Array = u @ vt
    (a, b, c), (d, e, f), (g, h, i) = out.tolist()
    if a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g) < 0.0:
        u[:, 2] *= -1.0
        out = u @ vt
    return out


def best_similarity(a: Array, b: Array, rotation: Array | None = None) -> Similarity:
    """Similarity from points `a` (N, 3) to `b` with the least squared error (Umeyama 1991).

    A rotation that is given is kept.
    """
    mean_a, mean_b = a.mean(0), b.mean(0)
    a, b = a - mean_a, b - mean_b
    if rotation is None:
        u, d, vt = np.linalg.svd(b.T @ a)
        sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
        rotation = u @ sign @ vt
        scale = float((d * np.diag(sign)).sum() / max(float((a * a).sum()), 1e-18))
    else:
        a = a @ rotation.T
        scale = float(np.sqrt((b * b).sum() / max(float((a * a).sum()), 1e-18)))
    return Similarity(scale, rotation, mean_b - scale * rotation @ mean_a)


def rotation_from_vector(rotvec: Array) -> Array:
    """Rotation (3, 3) of a rotation vector (3,) in radians (Rodrigues).

    >>> np.round(rotation_from_vector(np.array([0, 0, np.pi / 2])) @ [1, 0, 0], 6)
    array([0., 1., 0.])
    """
    v = np.ascontiguousarray(rotvec, np.float64)
    theta = length(v)
    x, y, z = v.tolist()
    k: Array = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if theta < 1e-8:
        r: Array = _IDENTITY + k + 0.5 * k @ k
        return r
    r = _IDENTITY + np.sin(theta) / theta * k + (1 - np.cos(theta)) / theta**2 * (k @ k)
    return r


def vector_from_rotation(rotation: Array) -> Array:
    """Rotation vector (3,) in radians of a rotation (3, 3); the inverse of the above."""
    quaternion = quaternion_from_rotation(rotation)
    w, v = quaternion[0], quaternion[1:].copy()
    s = length(v)
    if s < 1e-12:
        return 2.0 * v
    out: Array = v / s * 2.0 * np.arctan2(s, w)
    return out


def vectors_from_rotations(rotations: Array) -> Array:
    """Rotation vectors (N, 3) of rotations (N, 3, 3) by less than half a turn."""
    off = 0.5 * np.stack(
        [
            rotations[:, 2, 1] - rotations[:, 1, 2],
            rotations[:, 0, 2] - rotations[:, 2, 0],
            rotations[:, 1, 0] - rotations[:, 0, 1],
        ],
        1,
    )
    sine = np.linalg.norm(off, axis=1)
    cosine = 0.5 * (np.trace(rotations, axis1=1, axis2=2) - 1.0)
    angle = np.arctan2(sine, cosine)
    out: Array = off * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-12), 1.0)[:, None]
    return out


def rotation_from_quaternion(quaternion_wxyz: NDArray[Any]) -> Array:
    """Rotation (3, 3) of a quaternion w x y z; it is normalised first."""
    q = np.ascontiguousarray(quaternion_wxyz, np.float64)
    w, x, y, z = (q / length(q)).tolist()
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_rotation(rotation: Array) -> Array:
    """Unit quaternion w x y z, w >= 0, of a rotation (3, 3) (Shepperd's method)."""
    (a, b, c), (d, e, f), (g, h, i) = np.asarray(rotation, np.float64).tolist()
    t = a + e + i
    largest = max(t, a, e, i)
    if t == largest:
        q = np.array([1 + t, h - f, c - g, d - b])
    elif a == largest:
        q = np.array([h - f, 1 + 2 * a - t, b + d, c + g])
    elif e == largest:
        q = np.array([c - g, b + d, 1 + 2 * e - t, f + h])
    else:
        q = np.array([d - b, c + g, f + h, 1 + 2 * i - t])
    q = q / length(q)
    out: Array = -q if q[0] < 0 else q
    return out


def quaternion_from_euler(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Array:
    """Quaternion w x y z `ned_from_body` of aerospace roll, pitch, yaw (z-y-x, intrinsic)."""
    cr, sr = np.cos(roll_rad / 2), np.sin(roll_rad / 2)
    cp, sp = np.cos(pitch_rad / 2), np.sin(pitch_rad / 2)
    cy, sy = np.cos(yaw_rad / 2), np.sin(yaw_rad / 2)
    q = np.array(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )
    return -q if q[0] < 0 else q


def interpolate_rotation(rotation_a: Array, rotation_b: Array, fraction: float) -> Array:
    """Rotation on the shortest arc from a (fraction 0) to b (1); outside it extrapolates."""
    out: Array = rotation_a @ rotation_from_vector(
        fraction * vector_from_rotation(rotation_a.T @ rotation_b)
    )
    return out


def yaw_rotation(yaw_rad: float) -> Array:
    """Rotation (3, 3) about the down axis."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def yaw_angle(rotation: Array) -> float:
    """Angle about the down axis, in radians, of a rotation (3, 3) that is level or nearly so."""
    return float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def angle_between(rotation_a: Array, rotation_b: Array) -> float:
    """Angle in radians of the rotation from a to b."""
    return float(np.linalg.norm(vector_from_rotation(rotation_a.T @ rotation_b)))
