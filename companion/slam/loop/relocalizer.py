"""Where in a map a camera is that only knows what it sees: descriptors, then a pose by RANSAC.

With the vertical known two matches give a pose, without it four; what the pose predicts is then
looked for in the image, so that a place is believed for what it shows all over, not for a few
matches.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose
from companion.slam.features.matching import (
    MAX_DISTANCE_STRICT,
    hamming_matrix,
    match_descriptors,
    mutual_matches,
)
from companion.slam.features.orb_features import Features, Ints
from companion.slam.map.local_map import Projector
from companion.slam.map.sparse_map import Keyframe, SlamMap
from companion.slam.optimisation.pose_refinement import refine_pose
from companion.slam.optimisation.upright_pose import upright_pose

MIN_MATCHES = 12
MIN_INLIERS = 10
TILT_ERROR_PX = 12.0
"""What an error of the vertical may move a point by."""
MIN_SEEN, MIN_SEEN_SHARE = 30, 0.35
"""Map points that must be seen where a pose predicts them, and as a share of those predicted."""
MANY_INLIERS, MANY_SEEN_SHARE = 25, 0.2
"""Without the vertical: where so many matches agree, less of what the pose predicts is enough."""
N_AROUND = 6


@dataclass(frozen=True, slots=True, eq=False)
class Located:
    """A camera put into a map: which points it sees (M,), with which features (M,)."""

    camera_from_map: Pose
    points: Ints
    features: Ints
    keyframe: Keyframe


class Relocalizer:
    """Puts images into maps."""

    def __init__(self, camera: Camera) -> None:
        self._focal_px = camera.focal_px
        self._projector = Projector(camera)

    def locate(
        self, features: Features, slam_map: SlamMap, keyframe: Keyframe,
        level_from_camera: Array | None, seed: int, share: float = MIN_SEEN_SHARE,
    ) -> Located | None:  # fmt: skip
        """Put an image into a map by a keyframe that it may resemble; None if unsure.

        `level_from_camera` (3, 3), where the vertical is known, as in `upright_pose`; `share` as in
        `confirm`.
        """
        points, found = _alike(features, slam_map, keyframe, level_from_camera is None)
        if len(points) < MIN_MATCHES:
            return None
        start = self._solve(slam_map.positions[points], features, found, level_from_camera, seed)
        if start is None:
            return None
        pose, agree = start
        pose, inlier, _ = refine_pose(
            pose, slam_map.positions[points[agree]],
            features.normalised[found[agree]], features.whitening[found[agree]],
        )  # fmt: skip
        if inlier.sum() < MIN_INLIERS:
            return None
        if level_from_camera is None and inlier.sum() >= MANY_INLIERS:
            share = min(share, MANY_SEEN_SHARE)
        return self.confirm(features, slam_map, keyframe, pose, share)

    def confirm(
        self, features: Features, slam_map: SlamMap, keyframe: Keyframe, pose: Pose,
        share: float = MIN_SEEN_SHARE,
    ) -> Located | None:  # fmt: skip
        """Look for what a pose predicts, around a keyframe; None where less than `share` is seen.

        Of an image with few features no more than half of them need be seen.
        """
        ids = around(slam_map, keyframe)
        points, found = np.zeros(0, np.int64), np.zeros(0, np.int64)
        n_due = 0
        for radius_px in (10.0, 5.0):
            visible = self._projector.visible(slam_map, pose, ids)
            n_due = len(visible.ids)
            points, found = self._projector.search(slam_map, visible, features, radius_px)
            if len(points) < MIN_SEEN:
                return None
            pose, inlier, _ = refine_pose(
                pose, slam_map.positions[points],
                features.normalised[found], features.whitening[found],
            )  # fmt: skip
            points, found = points[inlier], found[inlier]
        if len(points) < max(MIN_SEEN, share * min(n_due, len(features) // 2)):
            return None
        return Located(pose, points, found, keyframe)

    def _solve(
        self, points: Array, features: Features, found: Ints, level_from_camera: Array | None,
        seed: int,
    ) -> tuple[Pose, Ints] | None:  # fmt: skip
        if level_from_camera is not None:
            upright = upright_pose(
                points, features.normalised[found], level_from_camera,
                TILT_ERROR_PX / self._focal_px, seed,
            )  # fmt: skip
            if upright is not None and upright[1].sum() >= MIN_INLIERS:
                return upright[0], np.flatnonzero(upright[1])
        f = self._focal_px
        params = cv2.UsacParams()
        params.randomGeneratorState = seed
        params.threshold = 4.0
        params.maxIterations = 300
        params.confidence = 0.999
        k = np.diag([f, f, 1.0])
        ok, _, rotvec, translation, inliers = cv2.solvePnPRansac(
            points, features.normalised[found] * f, k, None, params=params
        )
        if not ok or inliers is None or len(inliers) < MIN_INLIERS:
            return None
        rotation = np.asarray(cv2.Rodrigues(rotvec)[0], np.float64)
        agree = np.asarray(inliers, np.int64).ravel()
        return Pose(rotation, np.asarray(translation, np.float64).ravel()), agree


def _alike(
    features: Features, slam_map: SlamMap, keyframe: Keyframe, widely: bool
) -> tuple[Ints, Ints]:
    """Points and the features that look like them: of one keyframe, or of all around it."""
    if widely:
        ids = around(slam_map, keyframe)
        distances = hamming_matrix(slam_map.descriptors[ids], features.descriptors)
        nearest, found = mutual_matches(distances, MAX_DISTANCE_STRICT, 0.8)
        return ids[nearest], found
    seen, ids = slam_map.seen_by(keyframe)
    ia, ib = match_descriptors(keyframe.features, features, ratio=0.8)
    at = np.full(len(keyframe.features), -1)
    at[seen] = ids
    known = at[ia] >= 0
    return at[ia][known], ib[known]


def around(slam_map: SlamMap, keyframe: Keyframe, n: int = N_AROUND) -> Ints:
    """Points that a keyframe and those that share most with it see."""
    _, own = slam_map.seen_by(keyframe)
    mask = np.zeros(slam_map.n_points, bool)
    mask[own] = True
    for _, key in slam_map.covisible(own)[: n + 1]:
        mask[slam_map.seen_by(slam_map.keyframes[key])[1]] = True
    return np.flatnonzero(mask)
