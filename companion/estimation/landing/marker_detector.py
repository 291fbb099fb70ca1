"""Pose of one square marker in an image: found by its code, placed by its four corners.

Corners are refined to parts of a pixel and taken through the lens one by one, so that any lens will
do. A square seen in four points has two poses that explain it nearly as well (Schweighofer and Pinz
2006), found in closed form (Collins and Bartoli, Infinitesimal Plane-based Pose Estimation, 2014).
Their centres nearly coincide, unless the marker is small or the lens is off.

It depends on the image alone, so that it is the same in flight and in a replay.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from companion.config import LandingConfig
from companion.errors import InputError
from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, skew
from companion.messages import Bytes, Frame, LandingTarget

FAMILIES = {
    "apriltag_36h11": cv2.aruco.DICT_APRILTAG_36h11, "aruco_4x4_50": cv2.aruco.DICT_4X4_50,
    "aruco_5x5_100": cv2.aruco.DICT_5X5_100, "aruco_6x6_250": cv2.aruco.DICT_6X6_250,
}  # fmt: skip
CORRECTED = 0.5
"""Share of the wrong bits that a family could correct which are corrected. With all of them, 36h11
would take one in ten million random squares for a given marker; with these, one in a hundred."""
MIN_EDGE_PX = 14.0
"""Least edge of a marker: below, its 6 to 10 cells are not told apart."""
CORNER_PX = 0.5
"""Standard deviation of a corner, each axis, at least. Rendered markers have 0.2 to 0.5: the
smaller and the more oblique, the more."""
MAX_RESIDUAL_PX = 2.0
"""Largest root mean square distance of its corners from those of a square; beyond, it is none."""
PLAUSIBLE = 9.0
"""Difference of the sums of squared residuals, in standard deviations, up to which the second pose
may be the true one."""
MAX_APART = 0.05
"""Largest distance between the centres of two plausible poses, as a share of the range."""

NOT_SEEN, TWICE, SMALL, NO_SQUARE, AMBIGUOUS = (
    "not in view", "two in view", "too small", "not a flat square", "ambiguous",
)  # fmt: skip
NO_MOUNT, NO_CALIBRATION = "camera mount unknown", "camera not calibrated"
ON_GIMBAL = "camera on a gimbal"


@dataclass(frozen=True, slots=True)
class _Placed:
    """A pose of the marker: rotation (3, 3) and centre (3,) in the camera; corners' residuals."""

    rotation: Array
    centre: Array
    squares: float
    """Sum of the squared residuals of its corners, pixels."""


class MarkerDetector:
    """Finds the configured marker; InputError where its size or its number cannot be."""

    def __init__(self, config: LandingConfig, camera: Camera) -> None:
        dictionary = cv2.aruco.getPredefinedDictionary(FAMILIES[config.marker])
        n = len(dictionary.bytesList)
        if config.size_m <= 0.0:
            raise InputError("landing.size_m: the edge of the marker must be stated, in metres")
        if config.id >= n:
            raise InputError(f"landing.id: {config.marker} has numbers 0 to {n - 1}")
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        parameters.errorCorrectionRate = CORRECTED
        self._detector = cv2.aruco.ArucoDetector(dictionary, parameters)
        self._id, self._camera = config.id, camera
        half = 0.5 * config.size_m
        self._corners_m = np.array(
            [[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]]
        )

    def step(self, frame: Frame) -> LandingTarget:
        """The marker in a frame."""
        mount = self._camera.body_from_camera
        why_not = NO_MOUNT if mount is None else NO_CALIBRATION * self._camera.assumed
        if self._camera.gimbal is not None:
            why_not = ON_GIMBAL
        seen = None
        if not why_not:
            seen, why_not = self._seen(frame.grey)
        if seen is None or mount is None:
            return LandingTarget(frame.seq, frame.t_ns, why_not=why_not)
        edges = np.linalg.norm(seen - np.roll(seen, 1, 0), axis=1)
        size_px = float(edges.mean())
        if edges.min() < MIN_EDGE_PX:
            return LandingTarget(frame.seq, frame.t_ns, size_px=size_px, why_not=SMALL)
        poses = self._poses(seen)
        if not poses or np.sqrt(poses[0].squares / 4) > MAX_RESIDUAL_PX:
            return LandingTarget(frame.seq, frame.t_ns, size_px=size_px, why_not=NO_SQUARE)
        best = poses[0]
        spread: Array = np.zeros(3)
        if len(poses) > 1:
            spread = poses[1].centre - best.centre
            if np.linalg.norm(spread) > MAX_APART * np.linalg.norm(best.centre):
                return LandingTarget(frame.seq, frame.t_ns, size_px=size_px, why_not=AMBIGUOUS)
        covariance = self._covariance(best) + np.outer(spread, spread)
        sigma_body_m = np.sqrt(np.diag(mount.rotation @ covariance @ mount.rotation.T))
        normals = np.stack([pose.rotation[:, 2] for pose in poses]) @ mount.rotation.T
        return LandingTarget(
            frame.seq, frame.t_ns, mount.apply(best.centre), sigma_body_m, normals, size_px
        )

    def _seen(self, grey: Bytes) -> tuple[Array | None, str]:
        """Corners (4, 2) of the marker, pixels; else why there are none."""
        corners, ids, _ = self._detector.detectMarkers(grey)
        ours = [] if ids is None else np.flatnonzero(np.ravel(ids) == self._id)
        if len(ours) != 1:
            return None, TWICE if len(ours) else NOT_SEEN
        return np.asarray(corners[ours[0]], np.float64).reshape(4, 2), ""

    def _poses(self, seen_px: Array) -> list[_Placed]:
        """Plausible poses, the best first."""
        bearings = self._camera.normalise(seen_px)
        if not np.isfinite(bearings).all():
            return []
        n, rotations, centres, _ = cv2.solvePnPGeneric(
            self._corners_m, bearings, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
        poses = []
        for vector, centre in zip(rotations[:n], centres[:n], strict=True):
            rotation = np.asarray(cv2.Rodrigues(vector)[0], np.float64)
            place = np.asarray(centre, np.float64).ravel()
            there = self._corners_m @ rotation.T + place
            if there[:, 2].min() > 0.0:
                off = self._camera.project(there) - seen_px
                poses.append(_Placed(rotation, place, float((off**2).sum())))
        poses.sort(key=lambda pose: pose.squares)
        return [
            pose for pose in poses if pose.squares - poses[0].squares < PLAUSIBLE * CORNER_PX**2
        ]

    def _covariance(self, placed: _Placed) -> Array:
        """Covariance (3, 3) of the centre, camera axes, m2."""
        about = self._corners_m @ placed.rotation.T
        x, y, z = (about + placed.centre).T
        lens = self._camera.pixel_from_normalised_jacobian(np.stack([x / z, y / z], 1))
        rows = np.zeros((8, 6))
        for i in range(4):
            pinhole = np.array([[1.0, 0.0, -x[i] / z[i]], [0.0, 1.0, -y[i] / z[i]]]) / z[i]
            moved = np.hstack([-skew(about[i]), np.eye(3)])
            rows[2 * i : 2 * i + 2] = lens[i] @ pinhole @ moved
        variance_px = max(CORNER_PX**2, placed.squares / 2)  # eight measurements, six unknowns
        return np.asarray(np.linalg.inv(rows.T @ rows)[3:, 3:] * variance_px, np.float64)
