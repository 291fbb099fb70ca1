"""Keyframes of a segment as samples to align, with attitude and distance to the ground."""

from __future__ import annotations

import numpy as np

from companion.estimation.attitude.camera_attitude import CameraAttitude
from companion.estimation.georeference.alignment_sample import AlignmentSample
from companion.estimation.georeference.georeferencer import Georeferencer
from companion.estimation.georeference.height_above_ground import HeightAboveGround
from companion.geometry.transforms import Pose
from companion.slam.map.sparse_map import Keyframe, SlamMap

MAX_GROUND_DISTANCES = 40
"""Half a millisecond each, on the way to a pose; their median is no more certain of more."""


class SegmentSamples:
    """Samples by one mount `body_from_camera`, None where unknown."""

    def __init__(
        self, georeferencer: Georeferencer, attitude: CameraAttitude, body_from_camera: Pose | None
    ) -> None:
        self._georeferencer, self._attitude = georeferencer, attitude
        self._body_from_camera = body_from_camera

    def of(self, segment: SlamMap, keyframes: list[Keyframe]) -> list[AlignmentSample]:
        """Samples of some keyframes of a segment."""
        poses = [k.camera_from_map.inverse() for k in keyframes]
        ground_distances = self._ground_distances(segment, poses)
        return [
            AlignmentSample(k.t_ns, pose, self._attitude.of_keyframe(k.keyframe_id, k.t_ns), ground)
            for k, pose, ground in zip(keyframes, poses, ground_distances, strict=True)
        ]

    def _ground_distances(self, segment: SlamMap, poses: list[Pose]) -> list[float | None]:
        """Distances from cameras `map_from_camera` along the body axis to the ground, map units.

        None where unknown: without rangefinder, or with a gimbal.
        """
        mount = self._body_from_camera
        asked = self._georeferencer.has_ranges and self._attitude.used
        if mount is None or not poses or not asked:
            return [None] * len(poses)
        beams = [pose.rotation @ mount.rotation[2] for pose in poses]
        down = np.sum(beams, axis=0)
        ground = HeightAboveGround(segment.point_positions(), down / np.linalg.norm(down))
        compared = set(np.linspace(0, len(poses) - 1, MAX_GROUND_DISTANCES).astype(int).tolist())
        return [
            ground.distance(pose.translation, beam) if i in compared else None
            for i, (pose, beam) in enumerate(zip(poses, beams, strict=True))
        ]
