"""Pose of one frame in the active map: point matching, pose refinement, KLT fallback."""

from __future__ import annotations

import numpy as np

from companion.config import TrackingConfig
from companion.geometry.camera import Camera
from companion.geometry.transforms import Pose
from companion.slam.features.klt_tracking import track_points
from companion.slam.features.matching import match_descriptors
from companion.slam.features.orb_features import Ints
from companion.slam.features.patches import image_levels
from companion.slam.features.view import View
from companion.slam.initialisation.initializer import robust_rotation
from companion.slam.loop.relocalizer import Relocalised
from companion.slam.map.local_map import Projector, local_points
from companion.slam.map.patch_refinement import refine_features
from companion.slam.map.sparse_map import Keyframe, SlamMap
from companion.slam.mapping.atlas import Atlas
from companion.slam.optimisation.pose_refinement import refine_pose, robust_cost, solve_sqpnp

MAX_REFINED = 150
"""Points aligned by patches per frame: more cost time without improving the pose."""
MAX_KLT_POINTS = 200
LOST_PX = 60.0
"""Of a camera that was lost: a metre and a half at 15 m, with 500 pixels of focal length."""
MIN_VISIBLE_RATIO, ENOUGH_INLIERS = 0.08, 30
"""Inliers required without attitude: this ratio of the visible points, or so many."""


class FrameTracker:
    """Tracks frames in the active map, and holds the local map."""

    def __init__(self, config: TrackingConfig, camera: Camera, atlas: Atlas) -> None:
        self._config = config
        self._atlas = atlas
        self._camera, self._projector = camera, Projector(camera)
        self.local: Ints = np.zeros(0, np.int64)
        """Ids of the local map points around the last tracked view."""

    @property
    def _map(self) -> SlamMap:
        return self._atlas.map

    def reset(self) -> None:
        """Clear the local map after another map became active."""
        self.local = np.zeros(0, np.int64)

    def too_few_features(self, view: View) -> bool:
        """True if a view has too few features to be tracked."""
        return len(view.features) < self._config.min_inliers

    def match(
        self, view: View, guess: Pose, ids: Ints, radius_px: float, count: bool = False,
        min_inliers: int = 0, slam_map: SlamMap | None = None,
    ) -> bool:  # fmt: skip
        """Match points `ids` projected from `guess` within a radius and refine the pose; success.

        With `count` the visibility statistics of the points are updated. At least `min_inliers` are
        required. The points are of the active map, unless another is given.
        """
        slam_map = slam_map or self._map
        visible = self._projector.visible(slam_map, guess, ids)
        points, found = self._projector.search(slam_map, visible, view.features, radius_px)
        if len(points) < self._config.min_inliers:
            return False
        features = view.features
        pose, inlier, information = refine_pose(
            guess, slam_map.positions[points], features.normalised[found],
            features.whitening[found], rounds=4 if count else 2,  # at first roughly
        )  # fmt: skip
        n = int(inlier.sum())
        if n < max(self._config.min_inliers, min_inliers) or n < 0.3 * len(points):
            return False
        has_attitude = view.ned_from_camera is not None
        if (
            count
            and not has_attitude
            and n < min(MIN_VISIBLE_RATIO * len(visible.ids), ENOUGH_INLIERS)
        ):
            return False
        view.camera_from_map, view.information = pose, information
        view.point_ids[:] = -1
        view.point_ids[found[inlier]] = points[inlier]
        view.n_matches = len(points)
        if count:
            slam_map.n_visible[visible.ids] += 1
            slam_map.n_found[points[inlier]] += 1
        return True

    def match_turned(self, view: View, guess: Pose, last: View, min_inliers: int) -> bool:
        """Match a view from `guess`, turned as the images show, with the local map; success.

        Without attitude a prediction knows no turn that begins.
        """
        ia, ib = match_descriptors(last.features, view.features)
        if len(ia) < self._config.min_inliers:
            return False
        turn, _ = robust_rotation(
            last.features.normalised[ia], view.features.normalised[ib], self._camera.focal_px
        )
        rotation = turn @ last.camera_from_map.rotation
        centre = guess.inverse().translation
        return self.match(
            view, Pose(rotation, -rotation @ centre), self.local, 25.0, min_inliers=min_inliers
        )

    def match_around(self, view: View, guess: Pose, min_inliers: int) -> bool:
        """Match a view of a camera that was lost with the map about where it should be; success.

        It has gone on meanwhile; where it is by inertial navigation is off by degrees.
        """
        around = local_points(self._map, np.zeros(0, np.int64), guess.inverse().translation)
        return self.match(view, guess, around, LOST_PX, min_inliers=min_inliers)

    def track_local_map(self, view: View, guess: Pose) -> bool:
        """Track a view by the local map from a predicted pose; success."""
        if self.too_few_features(view):
            return False
        view.point_ids = np.full(len(view.features), -1)
        return self.match(view, guess, self.local, 25.0) or self.match(
            view, guess, self.local, 60.0
        )

    def track_klt(self, view: View, guess: Pose, last: View) -> bool:
        """Track a view by KLT from the last tracked view; success.

        The pose is then set, but points only where features match. The relative rotation must be
        measured.
        """
        if last.ned_from_camera is None or view.ned_from_camera is None:
            return False
        some = self.local[:: max(1, -(-len(self.local) // MAX_KLT_POINTS))]
        pose = track_points(
            self._camera, self._map.positions[some], last.grey, last.camera_from_map,
            view.grey, guess,
        )  # fmt: skip
        if pose is None:
            return False
        if not self.match(view, pose, self.local, 5.0):
            view.camera_from_map, view.information = pose, None
            view.point_ids = np.full(len(view.features), -1)
        return True

    def relocalise_by(self, view: View, keyframe: Keyframe) -> bool:
        """Relocalise a view against one keyframe."""
        relocalised = self._atlas.relocalise_by(
            view.features, keyframe, view.level_from_camera, view.seq
        )
        return relocalised is not None and self.verify(view, relocalised, self._map)

    def verify(self, view: View, relocalised: Relocalised, slam_map: SlamMap) -> bool:
        """Verify a pose that was relocalised in a map, by that map's points around it."""
        guess = relocalised.camera_from_map
        centre = guess.inverse().translation
        around = local_points(slam_map, relocalised.points, centre)
        return self.match(view, guess, around, 12.0, slam_map=slam_map)

    def update_local_map(self, view: View) -> None:
        """Set the local map to the points around a tracked view."""
        seen = view.point_ids[view.point_ids >= 0]
        pose = view.camera_from_map
        self.local = local_points(self._map, seen, -pose.rotation.T @ pose.translation)

    def refine(self, view: View) -> None:
        """Refine the pose by patch alignment of its points."""
        features = view.features
        normalised, whitening = features.normalised.copy(), features.whitening.copy()
        refined_for = np.full(len(features), -1)
        index = np.flatnonzero(view.point_ids >= 0)
        points = view.point_ids[index]
        some = np.arange(0, len(index), max(1, -(-len(index) // MAX_REFINED)))
        finer, white = normalised[index], whitening[index]
        finer[some], white[some], _ = refine_features(
            self._map, view.camera_from_map, features, index[some], points[some],
            image_levels(view.grey),
        )  # fmt: skip
        normalised[index], whitening[index] = finer, white
        refined_for[index[some]] = points[some]
        view.normalised, view.whitening, view.refined_for = normalised, whitening, refined_for
        positions = self._map.positions[points]
        pose, inlier, information = refine_pose(
            view.camera_from_map, positions, finer, white, rounds=2
        )
        has_attitude = view.ned_from_camera is not None
        if not has_attitude:
            start = solve_sqpnp(positions, finer)
            if start is not None:
                other, other_inlier, info = refine_pose(start, positions, finer, white)
                if robust_cost(other, positions, finer, white) < robust_cost(
                    pose, positions, finer, white
                ):
                    pose, inlier, information = other, other_inlier, info
        if inlier.sum() >= max(self._config.min_inliers, 0.5 * len(points)):
            view.camera_from_map, view.information = pose, information
            view.point_ids[index[~inlier]] = -1
