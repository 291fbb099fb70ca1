"""Messages about tracked frames and new keyframes."""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Pose
from companion.messages import KeyframeAdded, Track, TrackState
from companion.slam.features.view import View
from companion.slam.map.sparse_map import Keyframe, SlamMap


def track_of(slam_map: SlamMap, view: View, reference: Keyframe, backfilled: bool = False) -> Track:
    """Track message of a view: its pose in the map and relative to a keyframe."""
    map_from_camera = view.camera_from_map.inverse()
    relative = reference.camera_from_map @ map_from_camera
    unit = slam_map.unit_of.get(reference.keyframe_id, 1.0)
    return Track(
        view.seq, view.t_ns, TrackState.TRACKING, map_from_camera, reference.keyframe_id,
        Pose(relative.rotation, relative.translation / unit), view.n_inliers, view.n_matches,
        view.features.pixels[view.point_ids >= 0], backfilled, *_sigmas(view),
    )  # fmt: skip


def _sigmas(view: View) -> tuple[float, float]:
    """Standard deviations from the pose information: of position, map units, and attitude, rad."""
    if view.information is None:
        return float("inf"), float("inf")
    try:
        covariance = np.linalg.inv(view.information)
    except np.linalg.LinAlgError:
        return float("inf"), float("inf")
    variance = np.maximum(np.diag(covariance), 0.0)
    return float(np.sqrt(variance[3:].max())), float(np.sqrt(variance[:3].max()))


def keyframe_added(slam_map: SlamMap, keyframe: Keyframe) -> KeyframeAdded:
    """KeyframeAdded message of a keyframe, with the points that it observes."""
    _, ids = slam_map.observations_of(keyframe)
    return KeyframeAdded(
        keyframe.keyframe_id, keyframe.seq, keyframe.t_ns, keyframe.camera_from_map.inverse(),
        keyframe.camera_from_map.apply(slam_map.positions[ids]),
    )  # fmt: skip
