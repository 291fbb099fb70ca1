"""Which frames stay, as keyframes."""

from __future__ import annotations

import numpy as np

from companion.config import TrackingConfig
from companion.slam.map import Keyframe, SlamMap
from companion.slam.view import View


def wants_keyframe(
    config: TrackingConfig, slam_map: SlamMap, reference: Keyframe | None, view: View
) -> bool:
    """Whether a view shows so much that its `reference`, the last keyframe, does not."""
    if reference is None:
        return True
    _, ids = slam_map.seen_by(reference)
    firm = ids[slam_map.n_observers[ids] >= min(3, len(slam_map.keyframes))]
    share = view.n_inliers / max(len(firm), 1)
    tracked = view.point_ids[view.point_ids >= 0]
    position = slam_map.positions[tracked]
    pose = view.camera_from_map
    here = (-pose.rotation.T @ pose.translation) - position
    there = reference.centre - position
    cosine = (here * there).sum(1) / np.maximum(
        np.linalg.norm(here, axis=1) * np.linalg.norm(there, axis=1), 1e-12
    )
    parallax = float(np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1))))
    late = view.t_ns - reference.t_ns > config.keyframe_max_s * 1e9 and parallax > 0.5
    weak = share < config.keyframe_min_share and (parallax > 0.4 or share < 0.5)
    return weak or parallax > config.keyframe_parallax_deg or late


def keyframe_of(view: View, keyframe_id: int) -> Keyframe:
    """A view as a keyframe that sees no points yet."""
    return Keyframe(
        keyframe_id, view.seq, view.t_ns, view.camera_from_map, view.features,
        np.full(len(view.features), -1),
        view.features.normalised.copy() if view.normalised is None else view.normalised,
        view.features.whitening.copy() if view.whitening is None else view.whitening,
        np.full(len(view.features), -1) if view.refined_for is None else view.refined_for,
        view.grey, None if view.ned_from_camera is None else view.ned_from_camera[2],
    )  # fmt: skip
