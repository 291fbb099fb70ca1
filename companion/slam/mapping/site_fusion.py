"""Fusion of points of two site maps: those become one whose stored patches align.

No image is left to refine features by. The features of each map are sub-pixel about the corner of a
patch of its own, and two detections of a corner are up to a pixel apart: where both patches align,
the features of one point are moved to the corner of the other. Of points whose patches do not align
nothing is known to be the same.
"""

from __future__ import annotations

import numpy as np

from companion.geometry.camera import Camera
from companion.slam.features.orb_features import Ints
from companion.slam.map.local_map import Projector
from companion.slam.map.patch_refinement import align_points
from companion.slam.map.sparse_map import Keyframe, SlamMap
from companion.slam.mapping.pass_fusion import MAX_BITS, N_NEAR, RADIUS_PX, one_to_one, unite

MAX_APART_PX = 2.0
"""Of two corners at the level of a patch: as many sigmas of one there."""
REFINED = 1.5
"""Times as sharp as a detected corner: of an aligned patch it is three to six."""
ENOUGH_REFINED = 2
"""Observations, the reference view among them, that say where a point is."""


def fuse_sites(slam_map: SlamMap, camera: Camera) -> None:
    """Let points of held keyframes, the newer ones, take over those of all others that they are."""
    projector = Projector(camera)
    free = [k for key, k in slam_map.keyframes.items() if key not in slam_map.held]
    pairs = one_to_one(np.concatenate([_matches(slam_map, projector, k) for k in free]))
    dropped, kept = pairs.T
    apart_px, sure = align_points(slam_map, kept, dropped, MAX_APART_PX)
    _leave_out_corners(slam_map, dropped[sure])
    unite(slam_map, kept[sure], dropped[sure], apart_px[sure])


def _matches(slam_map: SlamMap, projector: Projector, keyframe: Keyframe) -> Ints:
    """Points of this keyframe and those of held ones that are found at their features (N, 2)."""
    others = slam_map.keyframes.keys() - slam_map.held
    near = slam_map.nearest(keyframe.centre, N_NEAR, others)
    seen = [slam_map.observations_of(slam_map.keyframes[key])[1] for key in near]
    points = np.setdiff1d(np.concatenate(seen), slam_map.observations_of(keyframe)[1])
    visible = projector.visible(slam_map, keyframe.camera_from_map, points)
    ids, features = projector.search(slam_map, visible, keyframe.features, RADIUS_PX, MAX_BITS)
    own = keyframe.point_ids[features]
    alive = (own >= 0) & slam_map.alive[own]
    return np.stack([own[alive], ids[alive]], 1)


def _leave_out_corners(slam_map: SlamMap, points: Ints) -> None:
    """Remove observations that no patch refined from points that enough others observe.

    They tell of another corner than that of the patch, which is known to be the other map's.
    """
    chosen = np.zeros(slam_map.n_points, bool)
    chosen[points] = True
    n_refined = np.zeros(slam_map.n_points, np.int64)
    corners: list[tuple[Keyframe, Ints, Ints]] = []
    for key, keyframe in slam_map.keyframes.items():
        features, ids = slam_map.observations_of(keyframe)
        features, ids = features[chosen[ids]], ids[chosen[ids]]
        sharpness = keyframe.whitening[features, 0, 0] / keyframe.features.whitening[features, 0, 0]
        refined = (sharpness > REFINED) | (slam_map.first_seen[ids] == key)
        n_refined[ids[refined]] += 1
        corners.append((keyframe, features[~refined], ids[~refined]))
    for keyframe, features, ids in corners:
        slam_map.remove_observations(keyframe, features[n_refined[ids] >= ENOUGH_REFINED])
