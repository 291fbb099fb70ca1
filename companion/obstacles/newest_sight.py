"""Points of things in the newest image, thin ones too."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose
from companion.messages import Bytes, MapUpdate, Track
from companion.obstacles.obstacle_sectors import FREE_M, MAX_M
from companion.obstacles.sight_depth import SightDepth, sight_depth
from companion.obstacles.sight_tracks import MOST_IMAGES, SightTracks
from companion.obstacles.sky import sky_rays

MAX_RELATIVE_SIGMA = 0.08
"""Of a depth that counts as known."""
NEAR_BY_RAD = np.radians(2.0)
"""From the edge of the sky to corners of what it is over; these are one in each square degree."""
SAME_RAD, SAME_RATIO = np.radians(2.0), 0.1
LEAST_TOGETHER = 3
"""Corners this near to one another, in direction and distance, are a thing; fewer are mistakes."""


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Of one image: its time, where it was taken, metres, and the corners that it shows.

    Corners have rays (N, 3), in world axes, with z 1 in the camera, inverse depths (N,) along
    these, 1/m, their standard deviations (N,), and what they surely do not exceed (N,). Rays
    through the sky are among them, which exceed nothing.
    """

    t_ns: int
    eye_world_m: Array
    rays_world: Array
    inverse_m: Array
    sigma: Array
    most_inverse_m: Array

    @property
    def is_sure(self) -> NDArray[np.bool_]:
        """Mask (N,) of corners whose depth is known."""
        return np.asarray(self.sigma <= MAX_RELATIVE_SIGMA * self.inverse_m)

    @property
    def points_world_m(self) -> Array:
        """Points (M, 3) of these."""
        sure = self.is_sure
        away_m = self.rays_world[sure] / self.inverse_m[sure, None]
        return np.asarray(self.eye_world_m + away_m)

    @property
    def ends_world_m(self) -> Array:
        """Up to where the rays of all (N, 3) surely meet nothing; a kilometre away at most."""
        least_m = self.rays_world / np.maximum(self.most_inverse_m, 1e-3)[:, None]
        return np.asarray(self.eye_world_m + least_m)


class NewestSight:
    """Follows corners from image to image while the camera is located in a metric map."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._begin()

    def _begin(self) -> None:
        self.newest: Seen | None = None
        """Of the last image of which something is known."""
        self._tracks = SightTracks(self._camera)
        self._places: deque[tuple[int, Pose]] = deque(maxlen=MOST_IMAGES)
        """Of the images: keyframe, and pose relative to it, which the map's corrections move."""

    def add(self, track: Track, grey: Bytes, update: MapUpdate) -> None:
        """Take the next image (H, W); passed over while its place is unknown."""
        place = self._place(track, update)
        if place is None:
            return
        self._places.append(place)
        poses = [pose for at in self._places if (pose := _world_pose(*at, update)) is not None]
        if len(poses) < len(self._places):  # of another map
            self._begin()
            return
        now = poses[-1]
        last = poses[-2] if len(poses) > 1 else now
        self._tracks.step(grey, now.rotation, now.rotation.T @ last.rotation)
        if len(poses) < 2:
            return
        depth = sight_depth(self._tracks.seen, poses, self._camera.fx)
        self._tracks.drop(depth.stray)
        sky = self._sky(grey, now, depth)
        none, certain = np.zeros(len(sky)), np.ones(len(sky))
        self.newest = Seen(
            track.t_ns, now.translation, np.concatenate([depth.rays @ now.rotation.T, sky]),
            np.r_[depth.inverse_m, none], np.r_[depth.sigma, certain],
            np.r_[depth.most_inverse_m, none],
        )  # fmt: skip

    def _sky(self, grey: Bytes, world_from_camera: Pose, depth: SightDepth) -> Array:
        """Rays (N, 3) in world axes through the sky, which is far away though it has no depth."""
        pixels, away = self._camera.project(depth.rays), np.linalg.norm(depth.rays, axis=1)
        far = away >= FREE_M * depth.most_inverse_m
        near = ~far & (away < FREE_M * depth.inverse_m)
        near &= depth.sigma <= MAX_RELATIVE_SIGMA * depth.inverse_m
        return sky_rays(
            grey, self._camera, world_from_camera, pixels[far], pixels[near], NEAR_BY_RAD
        )

    def _place(self, track: Track, update: MapUpdate) -> tuple[int, Pose] | None:
        """Keyframe and the pose relative to it; to an earlier one while its own is not told."""
        if track.keyframe_id is None or track.keyframe_from_camera is None:
            return None
        if update.place_of(track.keyframe_id) is not None:
            return track.keyframe_id, track.keyframe_from_camera
        before = self._places[-1][0] if self._places else None
        place = None if before is None else update.place_of(before)
        if before is None or place is None or track.map_from_camera is None:
            return None
        return before, place.inverse().apply_to_pose(track.map_from_camera)


def _world_pose(keyframe_id: int, keyframe_from_camera: Pose, update: MapUpdate) -> Pose | None:
    """`world_from_camera`, metres; None where the keyframe is unknown or nothing is metric."""
    place = update.place_of(keyframe_id)
    if place is None or update.georeference is None:
        return None
    world_from_map = update.georeference.world_from_map
    return world_from_map.apply_to_pose(place.apply_to_pose(keyframe_from_camera))


def things_in(seen: Seen, half_width_rad: float) -> Array:
    """Points (M, 3) that others confirm, near them in direction and distance, and their sides.

    A corner is in the middle of the window by which it was followed, that wide to either side.
    """
    from scipy.spatial import cKDTree  # 15 MB of the daemon, where obstacles are told alone

    rays: Array = seen.points_world_m - seen.eye_world_m
    rays = rays[np.linalg.norm(rays, axis=1) <= MAX_M * (1.0 + SAME_RATIO)]
    distance_m = np.linalg.norm(rays, axis=1)
    if len(rays) == 0:
        return rays
    scaled = np.c_[rays / (distance_m * SAME_RAD)[:, None], np.log(distance_m) / SAME_RATIO]
    together = cKDTree(scaled).query_ball_point(scaled, 1.0, return_length=True)
    thing = rays[together >= LEAST_TOGETHER]
    aside = half_width_rad * np.c_[-thing[:, 1], thing[:, 0], np.zeros(len(thing))]
    return np.asarray(seen.eye_world_m + np.concatenate([thing, thing + aside, thing - aside]))
