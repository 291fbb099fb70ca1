"""Poses of frames once more, after the keyframes about them have been adjusted."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from companion.geometry.transforms import Array, Pose
from companion.messages import TrackRefined
from companion.slam.features.orb_features import Ints
from companion.slam.features.view import View
from companion.slam.map.sparse_map import Keyframe, SlamMap
from companion.slam.mapping.mapper import WINDOW
from companion.slam.optimisation.pose_refinement import refine_pose

MIN_POINTS = 30
"""Points of a frame that must be left, and its inliers: fewer know its pose no better than all of
them did when it was tracked."""
MOST_WAITING = 600
"""Frames that wait: 5 MB. A hover makes no keyframes, and then nothing is adjusted either."""
MOST_AT_ONCE = 4
"""Frames that are refined with each new one, of which one is due on the mean: 0.13 ms each."""


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """Observations of a tracked frame: ids and births of points (N,), and where it saw them."""

    slam_map: SlamMap
    seq: int
    t_ns: int
    keyframe: Keyframe
    keyframe_from_camera: Pose
    """In the map's unit of when it was tracked."""
    unit: float
    points: Ints
    born: Ints
    normalised: Array
    whitening: Array


class RefinedFrames:
    """Keeps what tracked frames saw until local adjustment has passed them; then their pose again.

    A frame is tracked by points of which some were seen by two keyframes only, in a young map with
    a scale of its own. Later keyframes move these points, and the keyframe that the frame is told
    relative to, but not the frame. With the map held only.
    """

    def __init__(self) -> None:
        self._waiting: deque[_Seen] = deque()

    def add(self, slam_map: SlamMap, view: View, reference: Keyframe) -> None:
        """Keep a tracked view; that of a keyframe is adjusted with the map."""
        if view.t_ns == reference.t_ns:
            return
        features = np.flatnonzero(view.point_ids >= 0)
        if len(features) < MIN_POINTS:
            return
        points = view.point_ids[features]
        normalised, whitening = view.normalised, view.whitening
        if normalised is None or whitening is None:
            normalised, whitening = view.features.normalised, view.features.whitening
        seen = _Seen(
            slam_map, view.seq, view.t_ns, reference,
            reference.camera_from_map @ view.camera_from_map.inverse(),
            slam_map.unit_of.get(reference.keyframe_id, 1.0), points, slam_map.born[points],
            normalised[features], whitening[features],
        )  # fmt: skip
        self._waiting.append(seen)

    def due(self, next_keyframe_id: int, segments: list[SlamMap]) -> Iterator[TrackRefined]:
        """Refined poses of frames that local adjustment has passed, a few at a time."""
        for _ in range(MOST_AT_ONCE):
            if not self._waiting:
                return
            is_passed = self._waiting[0].keyframe.keyframe_id < next_keyframe_id - WINDOW
            if not is_passed and len(self._waiting) <= MOST_WAITING:
                return
            yield from _refined(self._waiting.popleft(), segments)

    def rest(self, segments: list[SlamMap]) -> Iterator[TrackRefined]:
        """All others, at the end of a flight."""
        while self._waiting:
            yield from _refined(self._waiting.popleft(), segments)


def _refined(seen: _Seen, segments: list[SlamMap]) -> Iterator[TrackRefined]:
    """The pose of a frame by its points as they are now; none where too few are left."""
    slam_map, keyframe = seen.slam_map, seen.keyframe
    if (
        not any(each is slam_map for each in segments)  # its points have other ids in another map
        or slam_map.keyframes.get(keyframe.keyframe_id) is not keyframe
    ):
        return
    left = slam_map.alive[seen.points] & (slam_map.born[seen.points] == seen.born)
    if np.count_nonzero(left) < MIN_POINTS:
        return
    unit = slam_map.unit_of.get(keyframe.keyframe_id, 1.0)
    before = seen.keyframe_from_camera
    guess = Pose(before.rotation, before.translation * (unit / seen.unit))
    pose, inlier, _ = refine_pose(
        guess.inverse() @ keyframe.camera_from_map, slam_map.positions[seen.points[left]],
        seen.normalised[left], seen.whitening[left], rounds=2,
    )  # fmt: skip
    n_inliers = int(np.count_nonzero(inlier))
    if n_inliers < max(MIN_POINTS, 0.5 * len(inlier)):
        return
    relative = keyframe.camera_from_map @ pose.inverse()
    yield TrackRefined(
        seen.seq, seen.t_ns, keyframe.keyframe_id,
        Pose(relative.rotation, relative.translation / unit),
    )  # fmt: skip
