"""Maps of known points and cameras, with features that need no image."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose, Similarity, yaw_rotation
from companion.messages import Bytes
from companion.slam.compiled.patch_alignment import STORED
from companion.slam.features.orb_features import Features
from companion.slam.features.patches import Patches, image_levels
from companion.slam.map.seen import Seen
from companion.slam.map.sparse_map import Keyframe, SlamMap
from tests.support.flights.scene import DOWN_LOOKING

CAMERA = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)
SCALE_FACTOR, N_LEVELS = 1.2, 8
N_WAVES = 12
"""Of the ground's grey, 5 to 20 pixels long as seen from HEIGHT."""
GREY = np.full((480, 640), 128, np.uint8)
HEIGHT = 10.0


class Ground:
    """Points over a square of ground, each with a descriptor of its own; z is down."""

    def __init__(self, rng: np.random.Generator, half: float = 30.0, n: int = 6000) -> None:
        self._rng = rng
        height = rng.uniform(-2.0, 0.0, n)
        self.points: Array = np.c_[rng.uniform(-half, half, (n, 2)), height]
        self.descriptors: Bytes = rng.integers(0, 256, (n, 32)).astype(np.uint8)
        looks = np.random.default_rng(int(self.descriptors[0, :4].view(np.uint32)[0]))
        wavelength_m, along = looks.uniform(0.1, 0.4, N_WAVES), looks.uniform(0, 2 * np.pi, N_WAVES)
        self._waves: Array = 2 * np.pi / wavelength_m * np.stack([np.cos(along), np.sin(along)])
        self._phases: Array = looks.uniform(0, 2 * np.pi, N_WAVES)

    def grey_at(self, places: Array) -> Bytes:
        """Grey levels (...,) of the ground, or of a level piece of it, at places (..., 2)."""
        waves = np.sin(places @ self._waves + self._phases).sum(-1)
        return np.asarray(np.clip(128 + 25 * waves, 0, 255), np.uint8)

    def patches(self, world_from_camera: Pose, seen: Array, index: Array) -> Patches:
        """Patches about pixels (N, 2), each the picture of a level piece of ground at a point."""
        corner = np.floor(seen) - STORED // 2 + 1
        steps = np.stack(np.meshgrid(np.arange(STORED), np.arange(STORED)), -1)
        pixels = corner[:, None, None] + steps
        rays = np.concatenate(
            [CAMERA.normalise(pixels.reshape(-1, 2)), np.ones((pixels[..., 0].size, 1))], 1
        ) @ world_from_camera.rotation.T  # fmt: skip
        depth = self.points[index, 2] - world_from_camera.translation[2]
        rays = rays.reshape(*pixels.shape[:3], 3)
        places = world_from_camera.translation[:2] + rays[..., :2] * depth[:, None, None, None]
        return Patches(self.grey_at(places), seen - corner, np.zeros(len(index), np.int64))

    def repeat(self, period: float) -> None:
        """Make descriptors periodic in x, as on a facade."""
        cell = np.floor((self.points % period) * 4).astype(np.int64)
        kind = cell[:, 0] * 10_000 + np.floor(self.points[:, 1] * 4).astype(np.int64)
        kinds, which = np.unique(kind, return_inverse=True)
        some = self._rng.integers(0, 256, (len(kinds), 32)).astype(np.uint8)
        self.descriptors = some[which]

    def seen_from(self, world_from_camera: Pose, noise_px: float = 0.3) -> tuple[Features, Array]:
        """Features of a camera, and the point that each observes."""
        rng = self._rng
        p = world_from_camera.inverse().apply(self.points)
        pixels = CAMERA.project(p) + rng.normal(scale=noise_px, size=(len(p), 2))
        with np.errstate(invalid="ignore"):
            inside = ((pixels > 20) & (pixels < [620, 460])).all(1)
        index = rng.permutation(np.flatnonzero(inside))[:600]
        flips = np.packbits(rng.random((len(index), 256)) < 0.06, axis=1)
        seen = pixels[index].astype(np.float32)
        normalised = CAMERA.normalise(seen)
        n = len(index)
        features = Features(
            seen, normalised, np.zeros(n, np.int64), np.zeros(n, np.float32),
            self.descriptors[index] ^ flips, np.ones(n),
            CAMERA.pixel_from_normalised_jacobian(normalised) / 1.0,
        )  # fmt: skip
        return features, index


def flown(place: Array, yaw_rad: float = 0.0) -> Pose:
    """`world_from_camera` of a nadir camera above (x, y), 10 m up."""
    return Pose(yaw_rotation(yaw_rad) @ DOWN_LOOKING, np.array([place[0], place[1], -HEIGHT]))


def mapped(
    ground: Ground, path: list[Pose], map_from_world: Similarity, first_id: int = 0,
    memory: int = 1000, after_each: Callable[[SlamMap, Keyframe], object] = lambda m, k: None,
) -> SlamMap:  # fmt: skip
    """The map of cameras along a path, with axes and unit of its own.

    A point is not matched any more `memory` keyframes after its first observation. `after_each` is
    called after each keyframe.
    """
    slam_map = SlamMap(SCALE_FACTOR, N_LEVELS, level=True)
    slam_map.first_keyframe_id = first_id
    levels = image_levels(GREY)
    known: dict[int, int] = {}
    for k, world_from_camera in enumerate(path):
        features, index = ground.seen_from(world_from_camera)
        inside = map_from_world.apply_to_pose(world_from_camera)
        keyframe = Keyframe(
            first_id + k, first_id + k, (first_id + k) * 500_000_000, inside.inverse(),
            Seen(features, features.normalised.copy(), features.whitening.copy()),
            np.full(len(features), -1), np.full(len(features), -1),
        )  # fmt: skip
        slam_map.keyframes[keyframe.keyframe_id] = keyframe
        oldest = first_id + k - memory
        known = {i: p for i, p in known.items() if slam_map.born[p] >= oldest and slam_map.alive[p]}
        fresh = np.array([i not in known for i in index.tolist()])
        new = np.flatnonzero(fresh)
        ids = slam_map.add_points(
            map_from_world.apply(ground.points[index[new]]),
            keyframe.keyframe_id, keyframe.features, new, levels,
        )  # fmt: skip
        patches = ground.patches(
            world_from_camera, features.pixels[new].astype(np.float64), index[new]
        )
        slam_map.patches.near[slam_map.patch_at[ids]] = patches.grey
        slam_map.patch_centre[ids], slam_map.patch_level[ids] = patches.centre, patches.level
        known.update(zip(index[new].tolist(), ids.tolist(), strict=True))
        points = np.array([known[i] for i in index.tolist()])
        slam_map.add_observations(keyframe, np.arange(len(features)), points)
        slam_map.update_geometry(points, [keyframe])
        slam_map.keyframes_moved()
        after_each(slam_map, keyframe)
    return slam_map


def bend(slam_map: SlamMap, per_keyframe: float) -> None:
    """Let the map drift sideways."""
    for key, keyframe in slam_map.keyframes.items():
        shift = np.array([0.0, per_keyframe * key, 0.0])
        pose = keyframe.camera_from_map.inverse()
        keyframe.camera_from_map = Pose(pose.rotation, pose.translation + shift).inverse()
    n = slam_map.n_points
    slam_map.positions[:n, 1] += per_keyframe * slam_map.first_seen[:n]
