"""Which frames stay, as keyframes."""

from __future__ import annotations

from itertools import islice

import numpy as np

from companion.config import TrackingConfig
from companion.slam.features.orb_features import Ints
from companion.slam.features.view import View
from companion.slam.map.sparse_map import Keyframe, SlamMap

NEWEST_ALONE = 8
"""So many of the newest keyframes do not stand in for a new one: slow flight needs more of them."""
MIN_SHARED, COVERED = 0.5, 0.75
"""One that does shows so much of what the view shows, within so much of the parallax allowed."""


def wants_keyframe(
    config: TrackingConfig, slam_map: SlamMap, reference: Keyframe, view: View, since_ns: int
) -> bool:
    """Whether a view shows so much that its `reference`, in use since then, does not."""
    share = view.n_inliers / max(len(_firm(slam_map, reference)), 1)
    parallax_deg = _parallax_deg(slam_map, reference, view)
    late = view.t_ns - since_ns > config.keyframe_max_s * 1e9 and parallax_deg > 0.5
    weak = share < config.keyframe_min_share and (parallax_deg > 0.4 or share < 0.5)
    return weak or parallax_deg > config.keyframe_parallax_deg or late


def covering(config: TrackingConfig, slam_map: SlamMap, view: View) -> Keyframe | None:
    """An older keyframe that shows what a view does, which then need not become one; or None.

    So that ground flown over again costs no more keyframes.
    """
    seen = view.point_ids[view.point_ids >= 0]
    newest = set(islice(reversed(slam_map.keyframes), NEWEST_ALONE))
    for n_shared, key in slam_map.covisible(seen):
        if n_shared < MIN_SHARED * len(seen):
            break
        keyframe = slam_map.keyframes[key]
        if (
            key not in newest
            and _parallax_deg(slam_map, keyframe, view) < COVERED * config.keyframe_parallax_deg
            and not wants_keyframe(config, slam_map, keyframe, view, view.t_ns)
        ):
            return keyframe
    return None


def _firm(slam_map: SlamMap, keyframe: Keyframe) -> Ints:
    """The points of a keyframe that others see too."""
    _, ids = slam_map.seen_by(keyframe)
    return ids[slam_map.n_observers[ids] >= min(3, len(slam_map.keyframes))]


def _parallax_deg(slam_map: SlamMap, reference: Keyframe, view: View) -> float:
    """By how much the view of the points has turned, seen from them."""
    position = slam_map.positions[view.point_ids[view.point_ids >= 0]]
    pose = view.camera_from_map
    here = (-pose.rotation.T @ pose.translation) - position
    there = reference.centre - position
    cosine = (here * there).sum(1) / np.maximum(
        np.linalg.norm(here, axis=1) * np.linalg.norm(there, axis=1), 1e-12
    )
    return float(np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1))))


def keyframe_of(view: View, keyframe_id: int) -> Keyframe:
    """A view as a keyframe that sees no points yet."""
    return Keyframe(
        keyframe_id, view.seq, view.t_ns, view.camera_from_map, view.features,
        np.full(len(view.features), -1),
        view.features.normalised.copy() if view.normalised is None else view.normalised,
        view.features.whitening.copy() if view.whitening is None else view.whitening,
        np.full(len(view.features), -1) if view.refined_for is None else view.refined_for,
        view.grey, view.ned_from_camera,
    )  # fmt: skip
