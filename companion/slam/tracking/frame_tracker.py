"""Where one view lies in the map: its points found in the image, and its pose from them."""

from __future__ import annotations

import numpy as np

from companion.config import TrackingConfig
from companion.geometry.camera import Camera
from companion.geometry.transforms import Pose
from companion.slam.features.klt_tracking import follow
from companion.slam.features.orb_features import Ints
from companion.slam.features.patches import image_levels
from companion.slam.features.view import View
from companion.slam.loop.relocalizer import Located
from companion.slam.map.local_map import Projector, local_points
from companion.slam.map.patch_refinement import refine_features
from companion.slam.map.sparse_map import Keyframe, SlamMap
from companion.slam.mapping.atlas import Atlas
from companion.slam.optimisation.pose_refinement import other_pose, refine_pose, robust_cost

MOST_REFINED = 150
"""Points laid over each image by their patches: no pose needs more of them, and they take time."""
MOST_FOLLOWED = 200
MIN_DUE_SHARE, ENOUGH = 0.08, 30
"""Without attitude what is found is at least this share of what should be seen, or so many."""


class Placer:
    """Places views in the map that is in use, and knows which of its points are around them."""

    def __init__(self, config: TrackingConfig, camera: Camera, atlas: Atlas) -> None:
        self._config = config
        self._atlas = atlas
        self._camera, self._projector = camera, Projector(camera)
        self.local: Ints = np.zeros(0, np.int64)
        """The points around the last view that was placed."""

    @property
    def _map(self) -> SlamMap:
        return self._atlas.map

    def forget(self) -> None:
        """Another map is in use."""
        self.local = np.zeros(0, np.int64)

    def sees_too_little(self, view: View) -> bool:
        """Whether a view has too few features to be placed at all."""
        return len(view.features) < self._config.min_inliers

    def match(
        self, view: View, guess: Pose, ids: Ints, radius_px: float, count: bool = False,
        at_least: int = 0,
    ) -> bool:  # fmt: skip
        """Look for the points `ids` as if from `guess`, so far around; whether the view is there.

        With `count` the points are told whether they were found where they should be. At least
        `at_least` must agree with the pose.
        """
        visible = self._projector.visible(self._map, guess, ids)
        points, found = self._projector.search(self._map, visible, view.features, radius_px)
        if len(points) < self._config.min_inliers:
            return False
        features = view.features
        pose, inlier, information = refine_pose(
            guess, self._map.positions[points], features.normalised[found],
            features.whitening[found], rounds=4 if count else 2,  # at first roughly
        )  # fmt: skip
        n = int(inlier.sum())
        if n < max(self._config.min_inliers, at_least) or n < 0.3 * len(points):
            return False
        told = view.ned_from_camera is not None
        if count and not told and n < min(MIN_DUE_SHARE * len(visible.ids), ENOUGH):
            return False
        view.camera_from_map, view.information = pose, information
        view.point_ids[:] = -1
        view.point_ids[found[inlier]] = points[inlier]
        view.n_matches = len(points)
        if count:
            self._map.n_visible[visible.ids] += 1
            self._map.n_found[points[inlier]] += 1
        return True

    def place_near(self, view: View, guess: Pose) -> bool:
        """Look for the points around the last view as if from `guess`; whether it was found."""
        if self.sees_too_little(view):
            return False
        view.point_ids = np.full(len(view.features), -1)
        return self.match(view, guess, self.local, 25.0) or self.match(
            view, guess, self.local, 60.0
        )

    def follow(self, view: View, guess: Pose, last: View) -> bool:
        """Follow the points around from a view that was placed; whether the view is there.

        It has a pose then, but shows points only as far as its features do. The turn between the
        two must have been told.
        """
        if last.ned_from_camera is None or view.ned_from_camera is None:
            return False
        some = self.local[:: max(1, -(-len(self.local) // MOST_FOLLOWED))]
        pose = follow(
            self._camera, self._map.positions[some], last.grey, last.camera_from_map,
            view.grey, guess,
        )  # fmt: skip
        if pose is None:
            return False
        if not self.match(view, pose, self.local, 5.0):
            view.camera_from_map, view.information = pose, None
            view.point_ids = np.full(len(view.features), -1)
        return True

    def locate_by(self, view: View, keyframe: Keyframe) -> bool:
        """Place a view as a lost camera would, by what one keyframe shows."""
        located = self._atlas.locate_by(view.features, keyframe, view.level_from_camera, view.seq)
        return located is not None and self.accept(view, located)

    def accept(self, view: View, located: Located) -> bool:
        """See whether a view fits the map where it was recognised."""
        view.camera_from_map = located.camera_from_map
        view.point_ids[:] = -1
        view.point_ids[located.features] = located.points
        self.refresh_local(view)
        return self.match(view, located.camera_from_map, self.local, 12.0)

    def refresh_local(self, view: View) -> None:
        """Take the points around a view that was placed as those to look for next."""
        seen = view.point_ids[view.point_ids >= 0]
        pose = view.camera_from_map
        self.local = local_points(self._map, seen, -pose.rotation.T @ pose.translation)

    def refine(self, view: View) -> None:
        """Lay the points' patches over the image, and take the pose from where they fit."""
        features = view.features
        normalised, whitening = features.normalised.copy(), features.whitening.copy()
        refined_for = np.full(len(features), -1)
        index = np.flatnonzero(view.point_ids >= 0)
        points = view.point_ids[index]
        some = np.arange(0, len(index), max(1, -(-len(index) // MOST_REFINED)))
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
        told = view.ned_from_camera is not None
        if not told:
            start = other_pose(positions, finer)
            if start is not None:
                other, theirs, info = refine_pose(start, positions, finer, white)
                if robust_cost(other, positions, finer, white) < robust_cost(
                    pose, positions, finer, white
                ):
                    pose, inlier, information = other, theirs, info
        if inlier.sum() >= max(self._config.min_inliers, 0.5 * len(points)):
            view.camera_from_map, view.information = pose, information
            view.point_ids[index[~inlier]] = -1
