"""Relocalisation without a predicted pose: descriptor matching, then pose by RANSAC.

With known gravity two matches give a pose, without it four. The pose is verified by the points that
it predicts all over the image.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose
from companion.slam.features.matching import (
    MAX_DISTANCE_STRICT,
    match_descriptors,
    mutual_matches,
)
from companion.slam.features.orb_features import Features, Ints
from companion.slam.map.local_map import Projector, Visible
from companion.slam.map.sparse_map import Keyframe, SlamMap
from companion.slam.optimisation.pose_refinement import refine_pose
from companion.slam.optimisation.upright_pose import upright_pose

MIN_MATCHES = 12
MIN_INLIERS = 10
TILT_ERROR_PX = 12.0
"""Image displacement allowed for errors of the measured vertical."""
MIN_FOUND, MIN_FOUND_RATIO = 30, 0.35
"""Predicted map points that must be found, and their ratio."""
MANY_INLIERS, LOW_FOUND_RATIO = 25, 0.2
"""Without known gravity: with so many inliers a lower found ratio suffices."""
N_COVISIBLE = 6
CHANCE_RATIO, CHANCE_SHIFT_PX = 3.0, 40.0
"""On another day (sun, leaves, direction) 5 to 10 % of the predicted points are found at a right
pose and 1 % at a wrong one: that many times more must be found than on the image shifted by this,
in each of four directions."""


@dataclass(frozen=True, slots=True, eq=False)
class Relocalised:
    """A relocalised camera: pose, the points it observes (M,), with which features (M,)."""

    camera_from_map: Pose
    points: Ints
    features: Ints
    keyframe: Keyframe


class Relocalizer:
    """Relocalises images in maps."""

    def __init__(self, camera: Camera) -> None:
        self._focal_px = camera.focal_px
        self._projector = Projector(camera)

    def relocalise(
        self, features: Features, slam_map: SlamMap, keyframe: Keyframe,
        level_from_camera: Array | None, seed: int, share: float | None = MIN_FOUND_RATIO,
    ) -> Relocalised | None:  # fmt: skip
        """Relocalise an image in a map against a candidate keyframe; None if uncertain.

        `level_from_camera` (3, 3), where gravity is known, as in `upright_pose`; `share` as in
        `verify`.
        """
        points, found = _candidate_matches(features, slam_map, keyframe, level_from_camera is None)
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
        if share is not None and level_from_camera is None and inlier.sum() >= MANY_INLIERS:
            share = min(share, LOW_FOUND_RATIO)
        return self.verify(features, slam_map, keyframe, pose, share)

    def verify(
        self, features: Features, slam_map: SlamMap, keyframe: Keyframe, pose: Pose,
        share: float | None = MIN_FOUND_RATIO,
    ) -> Relocalised | None:  # fmt: skip
        """Match the points predicted around a keyframe; None where less than `share` is found.

        For images with few features the number required is capped at half of them. Without a share,
        and of a keyframe of an earlier flight, it is a multiple of what chance finds instead.
        """
        ids = covisible_points(slam_map, keyframe)
        points, found = np.zeros(0, np.int64), np.zeros(0, np.int64)
        n_due = 0
        for radius_px in (10.0, 5.0):
            visible = self._projector.visible(slam_map, pose, ids)
            n_due = len(visible.ids)
            points, found = self._projector.search(slam_map, visible, features, radius_px)
            if len(points) < MIN_FOUND:
                return None
            pose, inlier, _ = refine_pose(
                pose, slam_map.positions[points],
                features.normalised[found], features.whitening[found],
            )  # fmt: skip
            points, found = points[inlier], found[inlier]
        if share is None or keyframe.keyframe_id in slam_map.held:
            n_required = CHANCE_RATIO * self._found_by_chance(features, slam_map, pose, ids)
        else:
            n_required = share * min(n_due, len(features) // 2)
        if len(points) < max(MIN_FOUND, n_required):
            return None
        return Relocalised(pose, points, found, keyframe)

    def n_in_view(self, slam_map: SlamMap, keyframe: Keyframe, camera_from_map: Pose) -> int:
        """Number of points about a keyframe that are in the view of a camera."""
        points = covisible_points(slam_map, keyframe)
        return len(self._projector.visible(slam_map, camera_from_map, points).ids)

    def _found_by_chance(self, features: Features, slam_map: SlamMap, pose: Pose, ids: Ints) -> int:
        """Number of points found where they are not predicted, at most."""
        due = self._projector.visible(slam_map, pose, ids)
        counts = []
        for step in ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)):
            shifted = Visible(due.ids, due.pixels + CHANCE_SHIFT_PX * np.array(step), due.octaves)
            counts.append(len(self._projector.search(slam_map, shifted, features, 5.0)[0]))
        return max(counts)

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


def _candidate_matches(
    features: Features, slam_map: SlamMap, keyframe: Keyframe, with_covisible: bool
) -> tuple[Ints, Ints]:
    """Descriptor matches: points and features, of a keyframe or also its covisible ones."""
    if with_covisible:
        ids = covisible_points(slam_map, keyframe)
        nearest, found = mutual_matches(
            slam_map.descriptors[ids], features.descriptors, MAX_DISTANCE_STRICT, 0.8
        )
        return ids[nearest], found
    seen, ids = slam_map.observations_of(keyframe)
    ia, ib = match_descriptors(keyframe.features, features)
    at = np.full(len(keyframe.features), -1)
    at[seen] = ids
    known = at[ia] >= 0
    return at[ia][known], ib[known]


def covisible_points(slam_map: SlamMap, keyframe: Keyframe) -> Ints:
    """Points observed by a keyframe and its `N_COVISIBLE` most covisible ones."""
    _, own = slam_map.observations_of(keyframe)
    mask = np.zeros(slam_map.n_points, bool)
    mask[own] = True
    for _, key in slam_map.covisible(own)[: N_COVISIBLE + 1]:
        mask[slam_map.observations_of(slam_map.keyframes[key])[1]] = True
    return np.flatnonzero(mask)
