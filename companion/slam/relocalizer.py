"""Where a lost camera is: descriptor matches with keyframes, then a pose that explains them."""

from __future__ import annotations

import cv2
import numpy as np

from companion.geometry import Pose
from companion.slam.features import Features, Ints
from companion.slam.map import Keyframe, SlamMap
from companion.slam.matching import match_descriptors
from companion.slam.pose_refinement import refine_pose

MIN_MATCHES = 15
MIN_INLIERS = 12


class Relocalizer:
    """Tries a few keyframes for each lost frame: the latest always, the others in turn."""

    def __init__(self, slam_map: SlamMap, focal_px: float) -> None:
        self._map = slam_map
        self._focal_px = focal_px
        self._next = 0

    def candidates(self, n_latest: int = 3, n_others: int = 4) -> list[Keyframe]:
        """The keyframes to try now."""
        keyframes = list(self._map.keyframes.values())
        latest = keyframes[-n_latest:][::-1]
        others = keyframes[:-n_latest]
        turn = [others[(self._next + i) % len(others)] for i in range(min(n_others, len(others)))]
        self._next += n_others
        return latest + turn

    def locate(
        self, features: Features, seed: int, keyframes: list[Keyframe]
    ) -> tuple[Pose, Ints, Ints] | None:
        """Pose `camera_from_map`, the points that support it and their features; None if unsure."""
        for keyframe in keyframes:
            seen, ids = self._map.seen_by(keyframe)
            ia, ib = match_descriptors(keyframe.features, features, ratio=0.75)
            at = np.full(len(keyframe.features), -1)
            at[seen] = ids
            known = at[ia] >= 0
            points, found = at[ia][known], ib[known]
            if len(points) < MIN_MATCHES:
                continue
            pose = self._solve(features, points, found, seed)
            if pose is None:
                continue
            refined, inlier, _ = refine_pose(
                pose, self._map.positions[points],
                features.normalised[found], features.whitening[found],
            )  # fmt: skip
            if inlier.sum() >= MIN_INLIERS:
                return refined, points[inlier], found[inlier]
        return None

    def _solve(self, features: Features, points: Ints, found: Ints, seed: int) -> Pose | None:
        f = self._focal_px
        params = cv2.UsacParams()
        params.randomGeneratorState = seed
        params.threshold = 4.0
        params.maxIterations = 300
        params.confidence = 0.999
        k = np.diag([f, f, 1.0])
        ok, _, rotvec, translation, inliers = cv2.solvePnPRansac(
            self._map.positions[points], features.normalised[found] * f, k, None, params=params
        )
        if not ok or inliers is None or len(inliers) < MIN_INLIERS:
            return None
        rotation = np.asarray(cv2.Rodrigues(rotvec)[0], np.float64)
        return Pose(rotation, np.asarray(translation, np.float64).ravel())
