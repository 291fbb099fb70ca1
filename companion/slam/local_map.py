"""The part of the map that a camera at a given pose should see, and its search in an image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.camera import Camera
from companion.geometry import Array, Pose
from companion.slam.features import Bools, Features, Ints
from companion.slam.map import SlamMap
from companion.slam.matching import match_projected

N_NEAREST = 8
MIN_VIEW_COSINE = 0.5
"""A point is looked for only within 60 degrees of where it was seen from before."""


@dataclass(frozen=True, slots=True, eq=False)
class Visible:
    """Points that should be in the image: ids (M,), pixels (M, 2), pyramid levels (M,)."""

    ids: Ints
    pixels: Array
    octaves: Ints


class Projector:
    """Projects map points into one camera, with all the reasons not to see a point."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        w, h = camera.width - 1.0, camera.height - 1.0
        edge = np.array(
            [[0, 0], [w / 2, 0], [w, 0], [0, h / 2], [w, h / 2], [0, h], [w / 2, h], [w, h]]
        )
        rim = camera.normalise(edge)
        # a distortion model folds back far outside the image: points there must not come in again
        self._max_radius = float(np.nanmax(np.linalg.norm(rim, axis=1), initial=0.5)) * 1.05

    def visible(self, slam_map: SlamMap, camera_from_map: Pose, ids: Ints) -> Visible:
        """Which of the points `ids` a camera at this pose should see, and where."""
        camera = self._camera
        position = slam_map.positions[ids]
        p = camera_from_map.apply(position)
        towards = (-camera_from_map.rotation.T @ camera_from_map.translation) - position
        distance = np.linalg.norm(towards, axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            n = p[:, :2] / p[:, 2:]
            ok = (p[:, 2] > 0) & ((n * n).sum(1) < self._max_radius**2)
            ok &= (towards * slam_map.normals[ids]).sum(1) > MIN_VIEW_COSINE * distance
            top = slam_map.base_distance[ids]
            ok &= distance < top * 1.3
            ok &= distance > top / slam_map.scale_factor ** (slam_map.n_levels - 1) * 0.7
        ids, p, distance = ids[ok], p[ok], distance[ok]
        px = camera.project(p)
        inside = (px[:, 0] >= 0) & (px[:, 1] >= 0)
        inside &= (px[:, 0] < camera.width) & (px[:, 1] < camera.height)
        ids, px, distance = ids[inside], px[inside], distance[inside]
        return Visible(ids, px, slam_map.expected_octaves(distance, ids))

    def search(
        self,
        slam_map: SlamMap,
        visible: Visible,
        features: Features,
        radius_px: float,
        usable: Bools | None = None,
        max_distance: float = 64,
        max_octave_gap: int = 2,
    ) -> tuple[Ints, Ints]:
        """Look for visible points within a radius (at pyramid level 0; wider above).

        Returns point ids and features.
        """
        radius = radius_px * slam_map.scale_factor ** visible.octaves.astype(np.float64)
        points, found = match_projected(
            visible.pixels, slam_map.descriptors[visible.ids], visible.octaves, features, radius,
            usable, max_distance, max_octave_gap=max_octave_gap,
        )  # fmt: skip
        return visible.ids[points], found


def local_points(slam_map: SlamMap, near_ids: Ints, centre: Array, n_keyframes: int = 20) -> Ints:
    """Points of the keyframes that share points with `near_ids`, and of the nearest ones in space.

    Keyframes near in space but not in time are how a place seen long ago is taken up again.
    """
    chosen = [k for _, k in slam_map.covisible(near_ids, 8)[:n_keyframes]]
    chosen += slam_map.nearest(centre, N_NEAREST, set(chosen))
    mask = np.zeros(slam_map.n_points, bool)
    for keyframe_id in chosen:
        mask[slam_map.seen_by(slam_map.keyframes[keyframe_id])[1]] = True
    return np.flatnonzero(mask)
