"""KLT tracking of map points between images, and the pose from it (Bouguet 2000).

Close to the ground and in blurred or low-contrast images corners are not detected again, but the
surrounding texture can still be tracked: pyramidal Lucas-Kanade from the last image, pre-warped by
the predicted homography to cancel rotation and scale.
"""

from __future__ import annotations

import cv2
import numpy as np

from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose
from companion.messages import Bytes
from companion.slam.features.orb_features import Bools

WINDOW_PX, N_LEVELS = 41, 4
MARGIN_PX = 8.0
MIN_POINTS, MIN_INLIER_RATIO = 15, 0.6
MAX_FORWARD_BACKWARD_PX = 2.0
"""Forward-backward error of a tracked point."""
MAX_REPROJECTION_PX = 5.0


def track_points(
    camera: Camera, points_map: Array, grey: Bytes, camera_from_map: Pose, next_grey: Bytes,
    guess: Pose,
) -> Pose | None:  # fmt: skip
    """Pose of the next image by tracking points (N, 3) from a posed image; None if uncertain.

    `guess` is the predicted `camera_from_map`; its rotation is kept: over a plane, translation and
    rotation cannot be separated in a low-resolution image.
    """
    here = camera.project(camera_from_map.apply(points_map))
    expected = camera.project(guess.apply(points_map))
    in_both = _inside(camera, here) & _inside(camera, expected)
    if np.count_nonzero(in_both) < MIN_POINTS:
        return None
    points, here, expected = points_map[in_both], here[in_both], expected[in_both]
    homography, _ = cv2.findHomography(here, expected)
    if homography is None:
        return None
    warped = np.asarray(
        cv2.warpPerspective(grey, homography, (camera.width, camera.height)), np.uint8
    )
    here = cv2.perspectiveTransform(here[:, None], homography)[:, 0].astype(np.float32)
    there, sure = _flow(warped, next_grey, here, expected.astype(np.float32))
    back, sure_back = _flow(next_grey, warped, there, here)
    kept = sure & sure_back & (np.linalg.norm(back - here, axis=1) < MAX_FORWARD_BACKWARD_PX)
    kept &= _inside(camera, there)
    points, there = points[kept], there[kept]
    if len(points) < MIN_POINTS:
        return None
    pose = _refine_translation(guess, points, camera.normalise(there), camera.focal_px)
    off_px = np.linalg.norm(camera.project(pose.apply(points)) - there, axis=1)
    n = np.count_nonzero(off_px < MAX_REPROJECTION_PX)  # nan: behind
    return pose if n >= max(MIN_POINTS, MIN_INLIER_RATIO * len(points)) else None


def _inside(camera: Camera, pixels: Array) -> Bools:
    """Mask of pixels inside the image by a margin; nan is outside."""
    far = np.array([camera.width, camera.height]) - MARGIN_PX
    return np.asarray(((pixels > MARGIN_PX) & (pixels < far)).all(1))


def _flow(grey: Bytes, next_grey: Bytes, here: Array, expected: Array) -> tuple[Array, Bools]:
    there, status, _ = cv2.calcOpticalFlowPyrLK(
        grey, next_grey, here, expected.copy(), winSize=(WINDOW_PX, WINDOW_PX),
        maxLevel=N_LEVELS - 1, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    return np.asarray(there), status[:, 0] > 0


def _refine_translation(guess: Pose, points: Array, normalised: Array, focal_px: float) -> Pose:
    """Pose with the rotation of `guess` that fits points best, by reweighted least squares."""
    rotated, shift = points @ guess.rotation.T, guess.translation
    for _ in range(8):
        depth = np.maximum((rotated + shift)[:, 2], 1e-6)[:, None]
        off_px = focal_px * np.linalg.norm((rotated + shift)[:, :2] / depth - normalised, axis=1)
        weight = 1.0 / (depth[:, 0] * (1.0 + (off_px / MAX_REPROJECTION_PX) ** 2))
        # x (z + t_z) = X + t_x, and so for y
        rows = np.zeros((len(points), 2, 3))
        rows[:, 0, 0] = rows[:, 1, 1] = 1.0
        rows[:, :, 2] = -normalised
        due = normalised * rotated[:, 2:] - rotated[:, :2]
        rows, due = rows * weight[:, None, None], due * weight[:, None]
        shift = np.linalg.lstsq(rows.reshape(-1, 3), due.ravel(), rcond=None)[0]
    return Pose(guess.rotation, shift)
