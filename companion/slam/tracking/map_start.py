"""Initialisation and continuation of a map by two views, and backfilling of earlier frames."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from companion.geometry.transforms import Pose
from companion.slam.features.patches import image_levels
from companion.slam.features.view import View
from companion.slam.initialisation.bootstrap import TwoViewReconstruction
from companion.slam.initialisation.map_continuation import MapContinuation
from companion.slam.map.sparse_map import Keyframe
from companion.slam.mapping.atlas import Atlas
from companion.slam.tracking.frame_tracker import FrameTracker


def initialise_map(
    atlas: Atlas, start: TwoViewReconstruction, first: Keyframe, second: Keyframe
) -> None:
    """Fill the empty active map with a reconstruction and its two keyframes."""
    slam_map = atlas.map
    assert second.grey is not None
    ids = slam_map.add_points(
        start.points_map, second.keyframe_id, second.features, start.features_second,
        image_levels(second.grey),
    )  # fmt: skip
    for keyframe in (first, second):
        keyframe.refined_for[:] = -1  # a view that was tracked in another map names points of that
    slam_map.first_keyframe_id = first.keyframe_id
    slam_map.keyframes[first.keyframe_id] = first
    slam_map.keyframes_moved()
    slam_map.add_observations(first, start.features_first, ids)
    slam_map.add_observations(second, start.features_second, ids)
    slam_map.update_geometry(ids, [first, second])
    mapper = atlas.mapper
    mapper.add(second)
    mapper.adjust_all(10)
    atlas.index_keyframe(first)
    atlas.index_keyframe(second)
    start.second.camera_from_map = second.camera_from_map
    start.second.point_ids = second.point_ids.copy()


def continue_map(
    atlas: Atlas,
    last_tracked: View,
    first: Keyframe,
    start: TwoViewReconstruction,
    continuation: MapContinuation,
) -> None:
    """Insert a reconstruction into the map that its first view was last tracked in.

    That view is `last_tracked`. Afterwards its keyframe `first` is in the map, and the second view
    has a pose and points.
    """
    slam_map, view = atlas.map, start.second
    tracked = np.flatnonzero(last_tracked.point_ids >= 0)
    tracked = tracked[slam_map.alive[last_tracked.point_ids[tracked]]]
    slam_map.keyframes[first.keyframe_id] = first
    slam_map.keyframes_moved()
    slam_map.add_observations(first, tracked, last_tracked.point_ids[tracked])
    ids = slam_map.add_points(
        continuation.points_map, first.keyframe_id, first.features, continuation.features_first,
        image_levels(last_tracked.grey),
    )  # fmt: skip
    slam_map.add_observations(first, continuation.features_first, ids)
    slam_map.update_geometry(ids, [first])
    atlas.index_keyframe(first)
    view.camera_from_map = continuation.second_from_map
    view.point_ids = np.full(len(view.features), -1)
    view.point_ids[start.features_second[continuation.known]] = continuation.known_points
    view.point_ids[start.features_second[~continuation.known]] = ids


def backfill(
    frame_tracker: FrameTracker,
    views: Iterable[View],
    first: View,
    second: View,
    reference: Keyframe,
    most: int | None = None,
) -> list[View]:
    """Track the buffered frames of before the initialisation, outwards from the first view.

    `reference` is the keyframe of the first view. Of more than `most` frames only each second,
    third or so from the first view is tracked.
    """
    views = [v for v in views if v.seq != second.seq]
    if most is not None:
        step = max(1, -(-len(views) // most))
        views = [v for v in views if (v.seq - first.seq) % step == 0]
    tracked_views: list[View] = []
    before = [v for v in views if v.seq <= first.seq][::-1]
    after = [v for v in views if v.seq > first.seq]
    for run, between in ((before, False), (after, True)):
        last, other, misses = first, second, 0
        for v in run:
            guess = _interpolated_pose(last, other, v)
            found = frame_tracker.track_local_map(v, guess) or frame_tracker.relocalise_by(
                v, reference
            )
            if found or frame_tracker.track_klt(v, guess, last):
                other = second if between or v.seq == first.seq else last
                last, misses = v, 0
                tracked_views.append(v)
            else:
                misses += 1
                if misses > 5 or abs(v.t_ns - last.t_ns) > 1e9:
                    break
    return sorted(tracked_views, key=lambda v: v.seq)


def _interpolated_pose(last: View, other: View, view: View) -> Pose:
    """Pose of a view by interpolation in time between two, rotated as measured."""
    share = (view.t_ns - last.t_ns) / ((other.t_ns - last.t_ns) or 1)
    centre = last.centre + share * (other.centre - last.centre)
    rotation = last.camera_from_map.rotation
    if view.ned_from_camera is not None and last.ned_from_camera is not None:
        rotation = view.ned_from_camera.T @ last.ned_from_camera @ rotation
    return Pose(rotation, -rotation @ centre)
