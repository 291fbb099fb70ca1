"""Projection of the local map into a camera, and search for its points in an image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.geometry.camera import Camera, Distortion
from companion.geometry.transforms import Array, Pose
from companion.slam.compiled.observing import distinct
from companion.slam.compiled.projecting import (
    EQUIDISTANT,
    N_COEFFICIENTS,
    NO_LENS,
    RADTAN,
    visible,
)
from companion.slam.compiled.searching import search
from companion.slam.features.orb_features import Features, Ints
from companion.slam.map.sparse_map import SlamMap

N_NEAREST = 8
MAX_DISTANCE, RATIO, MAX_OCTAVE_GAP = 64, 0.85, 2
"""Largest distance of matching descriptors, bits; its largest ratio to the second best; largest
difference from the predicted pyramid level."""
_MODELS = {
    Distortion.NONE: NO_LENS, Distortion.RADTAN: RADTAN, Distortion.EQUIDISTANT: EQUIDISTANT
}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Visible:
    """Points predicted to be in the image: ids (M,), pixels (M, 2), pyramid levels (M,)."""

    ids: Ints
    pixels: Array
    octaves: Ints


class Projector:
    """Projects map points into one camera, with visibility checks."""

    def __init__(self, camera: Camera) -> None:
        self._model = _MODELS[camera.distortion]
        self._coefficients = np.zeros(N_COEFFICIENTS)
        self._coefficients[: len(camera.coefficients)] = camera.coefficients
        self._intrinsics = np.array(
            [camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height], np.float64
        )
        u, v = np.meshgrid(
            np.linspace(0, camera.width - 1.0, 33), np.linspace(0, camera.height - 1.0, 25)
        )
        # over the whole image: at the rim of a fisheye there may be no rays
        rim = camera.normalise(np.stack([u.ravel(), v.ravel()], 1))
        # distortion models fold back far outside the image: exclude points there
        self._max_radius = float(np.nanmax(np.linalg.norm(rim, axis=1), initial=0.5)) * 1.05

    def visible(self, slam_map: SlamMap, camera_from_map: Pose, ids: Ints) -> Visible:
        """The points among `ids` that a camera at this pose should see, projected."""
        found, px, octaves = visible(
            slam_map.positions, slam_map.normals, slam_map.base_distance, ids,
            camera_from_map.rotation, camera_from_map.translation, self._model,
            self._coefficients, self._intrinsics, self._max_radius, slam_map.scale_factor,
            slam_map.n_levels,
        )  # fmt: skip
        return Visible(found, px, octaves)

    def search(
        self, slam_map: SlamMap, seen: Visible, features: Features, radius_px: float,
        max_distance: float = MAX_DISTANCE,
    ) -> tuple[Ints, Ints]:  # fmt: skip
        """Match visible points with features within a radius, in px at pyramid level 0.

        Descriptors differ by `max_distance` bits at most. Returns point ids (K,) and feature
        indices (K,), each at most once.
        """
        if len(seen.ids) == 0 or len(features) < 2:
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        radius = radius_px * slam_map.scale_factor ** seen.octaves.astype(np.float64)
        points, found = search(
            seen.pixels, seen.ids, slam_map.descriptors.view(np.uint64), seen.octaves, radius,
            features.pixels, features.descriptors.view(np.uint64), features.octaves,
            max_distance, RATIO, MAX_OCTAVE_GAP,
        )  # fmt: skip
        return seen.ids[points], found


def local_points(slam_map: SlamMap, near_ids: Ints, centre: Array, n_keyframes: int = 20) -> Ints:
    """Points of keyframes covisible with `near_ids`, and of the keyframes nearest to `centre` (3,).

    The spatially nearest ones let tracking reuse old parts of the map on a revisit.
    """
    chosen = [k for _, k in slam_map.covisible(near_ids, 8)[:n_keyframes]]
    chosen += slam_map.nearest(centre, N_NEAREST, set(chosen))
    if not chosen:
        return np.zeros(0, np.int64)
    seen = np.concatenate([slam_map.keyframes[each].point_ids for each in chosen])
    return distinct(seen, slam_map.alive)
