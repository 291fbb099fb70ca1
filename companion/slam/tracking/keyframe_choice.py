"""Keyframe decision."""

from __future__ import annotations

from itertools import islice

import numpy as np

from companion.slam.features.orb_features import Ints
from companion.slam.features.view import View
from companion.slam.map.seen import Seen
from companion.slam.map.sparse_map import Keyframe, SlamMap
from companion.slam.mapping.turned_view import MIN_SEEN, is_turn, median_parallax_deg

MIN_SHARE, MAX_PARALLAX_DEG, MAX_S = 0.75, 3.0, 3.0
"""A keyframe is inserted below this ratio of the reference's points (ORB-SLAM2's with depth), above
this parallax, or after this time with some. With 0.9 the sample flight has 141 keyframes instead of
125 and 5 mm less error, with 2 degrees 173 and the same, with 5 degrees 83 and 4 mm more."""
FEW_POINTS = 100
"""Without attitude a turn is not predicted: with fewer points than this in view the map must grow
before the reference has lost a quarter of its own, which may be few as well."""
N_NEWEST_EXCLUDED = 8
"""The newest keyframes never replace a new one: slow flight needs more of them."""
MIN_SHARED, MAX_PARALLAX_RATIO = 0.5, 0.75
"""Shared points required of a replacement, and its largest ratio of the parallax threshold."""


def needs_keyframe(slam_map: SlamMap, reference: Keyframe, view: View, since_ns: int) -> bool:
    """True if a view shows enough that `reference`, in use since `since_ns`, does not."""
    share = view.n_inliers / max(len(_well_observed(slam_map, reference)), 1)
    parallax_deg = _parallax_deg(slam_map, reference, view)
    late = view.t_ns - since_ns > MAX_S * 1e9 and parallax_deg > 0.5
    weak = share < MIN_SHARE and (parallax_deg > 0.4 or share < 0.5)
    unsure = view.ned_from_camera is None and view.n_inliers < FEW_POINTS and parallax_deg > 0.4
    return (
        weak or unsure or parallax_deg > MAX_PARALLAX_DEG or late
        or _turned_away(slam_map, reference, view, parallax_deg)
    )  # fmt: skip


def _turned_away(slam_map: SlamMap, reference: Keyframe, view: View, parallax_deg: float) -> bool:
    """True where a turn on the spot leaves few points in view, and half of `reference`'s."""
    return (
        view.n_inliers < MIN_SEEN * len(view.features)
        and view.n_inliers < 0.5 * len(slam_map.observations_of(reference)[1])
        and is_turn(parallax_deg, view.camera_from_map, reference.camera_from_map)
    )


def equivalent_keyframe(slam_map: SlamMap, view: View) -> Keyframe | None:
    """An older keyframe that makes a view redundant, or None.

    On return passes it becomes the reference instead of a new keyframe.
    """
    seen = view.point_ids[view.point_ids >= 0]
    newest = set(islice(reversed(slam_map.keyframes), N_NEWEST_EXCLUDED))
    for n_shared, key in slam_map.covisible(seen):
        if n_shared < MIN_SHARED * len(seen):
            break
        keyframe = slam_map.keyframes[key]
        if (
            key not in newest
            and _parallax_deg(slam_map, keyframe, view) < MAX_PARALLAX_RATIO * MAX_PARALLAX_DEG
            and not needs_keyframe(slam_map, keyframe, view, view.t_ns)
        ):
            return keyframe
    return None


def _well_observed(slam_map: SlamMap, keyframe: Keyframe) -> Ints:
    """Points of a keyframe with several observers."""
    _, ids = slam_map.observations_of(keyframe)
    return ids[slam_map.n_observers[ids] >= min(3, len(slam_map.keyframes))]


def _parallax_deg(slam_map: SlamMap, reference: Keyframe, view: View) -> float:
    """Median parallax of the points of a view between it and a keyframe."""
    position = slam_map.positions[view.point_ids[view.point_ids >= 0]]
    return median_parallax_deg(position, view.camera_from_map, reference.camera_from_map)


def keyframe_of(view: View, keyframe_id: int) -> Keyframe:
    """A keyframe from a view, without observations."""
    return Keyframe(
        keyframe_id, view.seq, view.t_ns, view.camera_from_map,
        Seen(
            view.features,
            view.features.normalised.copy() if view.normalised is None else view.normalised,
            view.features.whitening.copy() if view.whitening is None else view.whitening,
        ),
        np.full(len(view.features), -1),
        np.full(len(view.features), -1) if view.refined_for is None else view.refined_for,
        view.grey, view.ned_from_camera,
    )  # fmt: skip
