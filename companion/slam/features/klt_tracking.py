"""Map points followed from one image into the next by what is around them, and the pose of that.

Close above the ground, and in blurred or faint pictures, corners are not found again, but the
pattern around each still is: pyramidal Lucas-Kanade (Bouguet 2000), from the one image bent to
where the other is expected to show it, so that turns and changes of size do not matter.
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
MIN_POINTS, MIN_AGREE_SHARE = 15, 0.6
MAX_RETURN_PX = 2.0
"""A point that was followed and followed back must be near where it began."""
MAX_OFF_PX = 5.0


def follow(
    camera: Camera, points_map: Array, grey: Bytes, camera_from_map: Pose, next_grey: Bytes,
    guess: Pose,
) -> Pose | None:  # fmt: skip
    """The pose of the next image from points (N, 3) that are in one with a pose; None if unsure.

    `guess` is where the camera of the next image is expected; its rotation must be right: over a
    plane a coarse picture cannot tell a shift from a turn.
    """
    here = camera.project(camera_from_map.apply(points_map))
    expected = camera.project(guess.apply(points_map))
    in_both = _inside(camera, here) & _inside(camera, expected)
    if np.count_nonzero(in_both) < MIN_POINTS:
        return None
    points, here, expected = points_map[in_both], here[in_both], expected[in_both]
    bend, _ = cv2.findHomography(here, expected)
    if bend is None:
        return None
    bent = np.asarray(cv2.warpPerspective(grey, bend, (camera.width, camera.height)), np.uint8)
    here = cv2.perspectiveTransform(here[:, None], bend)[:, 0].astype(np.float32)
    there, sure = _flow(bent, next_grey, here, expected.astype(np.float32))
    back, sure_back = _flow(next_grey, bent, there, here)
    kept = sure & sure_back & (np.linalg.norm(back - here, axis=1) < MAX_RETURN_PX)
    kept &= _inside(camera, there)
    points, there = points[kept], there[kept]
    if len(points) < MIN_POINTS:
        return None
    pose = _shifted(guess, points, camera.normalise(there), camera.focal_px)
    off_px = np.linalg.norm(camera.project(pose.apply(points)) - there, axis=1)
    n = np.count_nonzero(off_px < MAX_OFF_PX)  # nan: behind
    return pose if n >= max(MIN_POINTS, MIN_AGREE_SHARE * len(points)) else None


def _inside(camera: Camera, pixels: Array) -> Bools:
    """Which are well inside the image; those that are nowhere are not."""
    far = np.array([camera.width, camera.height]) - MARGIN_PX
    return np.asarray(((pixels > MARGIN_PX) & (pixels < far)).all(1))


def _flow(grey: Bytes, next_grey: Bytes, here: Array, expected: Array) -> tuple[Array, Bools]:
    there, status, _ = cv2.calcOpticalFlowPyrLK(
        grey, next_grey, here, expected.copy(), winSize=(WINDOW_PX, WINDOW_PX),
        maxLevel=N_LEVELS - 1, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    return np.asarray(there), status[:, 0] > 0


def _shifted(guess: Pose, points: Array, normalised: Array, focal_px: float) -> Pose:
    """The pose with the rotation of `guess` that fits points best, by reweighted least squares."""
    turned, shift = points @ guess.rotation.T, guess.translation
    for _ in range(8):
        depth = np.maximum((turned + shift)[:, 2], 1e-6)[:, None]
        off_px = focal_px * np.linalg.norm((turned + shift)[:, :2] / depth - normalised, axis=1)
        weight = 1.0 / (depth[:, 0] * (1.0 + (off_px / MAX_OFF_PX) ** 2))
        # x (z + t_z) = X + t_x, and so for y
        rows = np.zeros((len(points), 2, 3))
        rows[:, 0, 0] = rows[:, 1, 1] = 1.0
        rows[:, :, 2] = -normalised
        due = normalised * turned[:, 2:] - turned[:, :2]
        rows, due = rows * weight[:, None, None], due * weight[:, None]
        shift = np.linalg.lstsq(rows.reshape(-1, 3), due.ravel(), rcond=None)[0]
    return Pose(guess.rotation, shift)
