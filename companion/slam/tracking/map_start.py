"""How a map begins with two views, or goes on with them, and what came before them is placed."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from companion.geometry.transforms import Pose
from companion.slam.features.patches import image_levels
from companion.slam.features.view import View
from companion.slam.initialisation.bootstrap import Start
from companion.slam.initialisation.map_continuation import Bridge
from companion.slam.map.sparse_map import Keyframe
from companion.slam.mapping.atlas import Atlas
from companion.slam.tracking.frame_tracker import Placer


def begin_map(atlas: Atlas, start: Start, first: Keyframe, second: Keyframe) -> None:
    """Fill the map in use, which is empty, with the points of a Start and its two keyframes."""
    slam_map = atlas.map
    assert second.grey is not None
    ids = slam_map.add_points(
        start.points_map, second, start.features_second, image_levels(second.grey)
    )
    for keyframe in (first, second):
        keyframe.refined_for[:] = -1  # a view that was tracked in another map names points of that
    slam_map.first_keyframe_id = first.keyframe_id
    slam_map.keyframes[first.keyframe_id] = first
    slam_map.poses_changed()
    slam_map.observe(first, start.features_first, ids)
    slam_map.observe(second, start.features_second, ids)
    slam_map.refresh(ids, [first, second])
    mapper = atlas.mapper
    mapper.add(second)
    mapper.adjust_all(10)
    atlas.remember(first)
    atlas.remember(second)
    start.second.camera_from_map = second.camera_from_map
    start.second.point_ids = second.point_ids.copy()


def carry_on(atlas: Atlas, ashore: View, first: Keyframe, start: Start, across: Bridge) -> None:
    """Take two views into the map that the first of them, `ashore`, was the last to be tracked in.

    Its keyframe `first` is in the map then, the second view has a pose and points in it.
    """
    slam_map, view = atlas.map, start.second
    tracked = np.flatnonzero(ashore.point_ids >= 0)
    tracked = tracked[slam_map.alive[ashore.point_ids[tracked]]]
    slam_map.keyframes[first.keyframe_id] = first
    slam_map.poses_changed()
    slam_map.observe(first, tracked, ashore.point_ids[tracked])
    ids = slam_map.add_points(
        across.points_map, first, across.features_first, image_levels(ashore.grey)
    )
    slam_map.observe(first, across.features_first, ids)
    slam_map.refresh(ids, [first])
    atlas.remember(first)
    view.camera_from_map = across.second_from_map
    view.point_ids = np.full(len(view.features), -1)
    view.point_ids[start.features_second[across.known]] = across.known_points
    view.point_ids[start.features_second[~across.known]] = ids


def place_earlier(
    placer: Placer, views: Iterable[View], first: View, second: View, reference: Keyframe
) -> list[View]:
    """Place the frames that came before the map: from the first view outwards.

    `reference` is the first view's keyframe.
    """
    views = [v for v in views if v.seq != second.seq]
    placed: list[View] = []
    before = [v for v in views if v.seq <= first.seq][::-1]
    after = [v for v in views if v.seq > first.seq]
    for run, between in ((before, False), (after, True)):
        last, other, misses = first, second, 0
        for v in run:
            guess = _on_the_way(last, other, v)
            found = placer.place_near(v, guess) or placer.locate_by(v, reference)
            if found or placer.follow(v, guess, last):
                other = second if between or v.seq == first.seq else last
                last, misses = v, 0
                placed.append(v)
            else:
                misses += 1
                if misses > 5 or abs(v.t_ns - last.t_ns) > 1e9:
                    break
    return sorted(placed, key=lambda v: v.seq)


def _on_the_way(last: View, other: View, view: View) -> Pose:
    """Where a view is that is between or beyond two with poses, by time; turned as is told."""
    share = (view.t_ns - last.t_ns) / ((other.t_ns - last.t_ns) or 1)
    centre = last.centre + share * (other.centre - last.centre)
    rotation = last.camera_from_map.rotation
    if view.ned_from_camera is not None and last.ned_from_camera is not None:
        rotation = view.ned_from_camera.T @ last.ned_from_camera @ rotation
    return Pose(rotation, -rotation @ centre)
