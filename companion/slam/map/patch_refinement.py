"""Sub-pixel refinement of features by alignment of the map points' reference patches."""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Array, Pose
from companion.messages import Bytes
from companion.slam.compiled.projecting import warps
from companion.slam.features.orb_features import Bools, Features, Ints
from companion.slam.features.patches import Patches, align, image_levels
from companion.slam.map.sparse_map import Keyframe, SlamMap

SIGMA_PX = 0.35
"""Expected error of an aligned patch at full resolution; it scales with the pyramid level."""
MAX_MOVE_SIGMAS = 2.0


def refine_features(
    slam_map: SlamMap,
    camera_from_map: Pose,
    features: Features,
    index: Ints,
    points: Ints,
    levels: list[Bytes],
) -> tuple[Array, Array, Bools]:
    """Refined positions of features `index` (M,), which observe map points `points` (M,).

    Returns their `normalised` (M, 2) and `whitening` (M, 2, 2) as in Features, unchanged where
    alignment failed, and a mask of success (M,).
    """
    sigma = features.sigma_px[index]
    normalised, whitening = features.normalised[index], features.whitening[index]
    jacobian = whitening * sigma[:, None, None]
    warp = _warps(slam_map, camera_from_map, points, jacobian)
    pixels = features.pixels[index].astype(np.float64)
    found, sure = align(slam_map.patches_of(points), warp, levels, pixels, MAX_MOVE_SIGMAS * sigma)
    moved = np.linalg.solve(jacobian[sure], (found - pixels)[sure][..., None])[..., 0]
    normalised, whitening = normalised.copy(), whitening.copy()
    normalised[sure] += moved
    size = 2.0 ** slam_map.patch_level[points[sure]]
    whitening[sure] = jacobian[sure] / (SIGMA_PX * size)[:, None, None]
    return normalised, whitening, sure


def align_points(
    slam_map: SlamMap, points: Ints, others: Ints, max_apart_px: float
) -> tuple[Array, Bools]:
    """Alignment of the patches of points (M,) with those of others (M,), without any image.

    Returns where each point is seen beside the other, in pixels (M, 2) of the other's reference
    view, and a mask of success (M,). `max_apart_px` is at the level of the other's patch.
    """
    own, theirs = slam_map.patches_of(points), slam_map.patches_of(others)
    size = 2.0 ** np.maximum(theirs.level, 0)
    inverse = np.linalg.inv(slam_map.first_unproject[others])
    jacobian = np.asarray(inverse / size[:, None, None], np.float64)
    warp = np.full((len(points), 2, 2), np.nan)
    views = slam_map.first_seen[others]
    for view in np.unique(views).tolist():
        pose = slam_map.pose_of(view)
        if pose is not None:
            here = np.flatnonzero(views == view)
            warp[here] = _warps(slam_map, pose, points[here], jacobian[here])
    apart, sure = np.zeros((len(points), 2)), theirs.level >= 0
    for n in np.flatnonzero(sure).tolist():
        one = slice(n, n + 1)
        found, sure[one] = align(
            Patches(own.grey[one], own.centre[one], own.level[one]), warp[one],
            image_levels(theirs.grey[n]), theirs.centre[one], np.array([max_apart_px]),
        )  # fmt: skip
        apart[one] = (found - theirs.centre[one]) * size[n]
    return apart, sure


def move_features(
    slam_map: SlamMap, keyframe: Keyframe, features: Ints, points: Ints, apart_px: Array
) -> None:
    """Move features (M,) of points (M,) by what is `apart_px` (M, 2) in their reference views."""
    sigma = keyframe.features.sigma_px[features]
    jacobian = keyframe.features.whitening[features] * sigma[:, None, None]
    warp = _warps(slam_map, keyframe.camera_from_map, points, jacobian)
    moved = np.linalg.solve(jacobian, warp @ apart_px[..., None])[..., 0]
    keyframe.normalised[features] += moved


def _warps(slam_map: SlamMap, camera_from_map: Pose, points: Ints, jacobian: Array) -> Array:
    """Affine warps (M, 2, 2) of full-resolution pixels from each reference view to this view."""
    if len(points) == 0:
        return np.zeros((0, 2, 2))
    first_ids, which = np.unique(slam_map.first_seen[points], return_inverse=True)
    firsts = [slam_map.pose_of(first_id) for first_id in first_ids.tolist()]
    poses = [Pose.identity() if first is None else first for first in firsts]
    return warps(
        slam_map.positions, slam_map.first_unproject, points,
        camera_from_map.rotation, camera_from_map.translation,
        np.stack([p.rotation for p in poses]), np.stack([p.translation for p in poses]),
        np.array([p is not None for p in firsts]), which, jacobian,
    )  # fmt: skip
