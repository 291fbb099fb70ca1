"""Sub-pixel refinement of features by alignment of the map points' reference patches."""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Array, Pose
from companion.messages import Bytes
from companion.slam.compiled.projecting import warps
from companion.slam.features.orb_features import Bools, Features, Ints
from companion.slam.features.patches import align
from companion.slam.map.sparse_map import SlamMap

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
