"""The sparse map: keyframes, points, and who sees what. One owner, no locks.

Points live in growing arrays so that a frame's work is a few vector operations; a point's index is
its identity for as long as it lives and is not used again.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from companion.geometry import Array, Pose, Similarity
from companion.messages import Bytes, Floats
from companion.slam.features import Bools, Features, Ints
from companion.slam.patches import STORED, Patches, cut, level_of

ARRAYS = (
    "positions", "alive", "descriptors", "normals", "base_distance", "n_visible", "n_found",
    "n_observers", "born", "first_seen", "first_unproject", "patch_grey", "patch_centre",
    "patch_level",
)  # fmt: skip


@dataclass(slots=True, eq=False)
class Keyframe:
    """A frame that stays: `point_ids` (N,) names the map point of each feature, -1 where none."""

    keyframe_id: int
    seq: int
    t_ns: int
    camera_from_map: Pose
    features: Features
    point_ids: Ints
    normalised: Array
    whitening: Array
    """(N, 2), (N, 2, 2) as those of the features, finer where a point's patch was found"""
    refined_for: Ints
    """(N,) the point with whose patch each feature was refined, -1 where it was not"""
    grey: Bytes | None = None
    """the image, while it may be looked at again"""

    @property
    def centre(self) -> Array:
        """Position of the camera in the map."""
        out: Array = -self.camera_from_map.rotation.T @ self.camera_from_map.translation
        return out


@dataclass(slots=True, eq=False)
class SlamMap:
    """All keyframes and points. Arrays are over-allocated; `n_points` of each are in use."""

    scale_factor: float
    n_levels: int
    first_keyframe_id: int = -1
    """By which it is told from other maps; -1 before it has begun."""
    level: bool = False
    """Whether the z axis is known to point down."""
    keyframes: dict[int, Keyframe] = field(default_factory=dict)
    """In order of their ids."""
    unit_of: dict[int, float] = field(default_factory=dict)
    """Map units to one unit of what was said of a keyframe when it was made, where not 1."""
    n_points: int = 0
    positions: Array = field(default_factory=lambda: np.zeros((0, 3)))
    alive: Bools = field(default_factory=lambda: np.zeros(0, bool))
    descriptors: Bytes = field(default_factory=lambda: np.zeros((0, 32), np.uint8))
    normals: Array = field(default_factory=lambda: np.zeros((0, 3)))
    """mean viewing direction, from point to camera"""
    base_distance: Array = field(default_factory=lambda: np.zeros(0))
    """distance at which the point would be seen at pyramid level 0"""
    n_visible: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    n_found: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    n_observers: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    born: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    """keyframe id at which the point was made"""
    first_seen: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    """keyframe id of the view that the patch is from"""
    first_unproject: Array = field(default_factory=lambda: np.zeros((0, 2, 2)))
    """derivative of that view's normalised coordinates by its pixels"""
    patch_grey: Bytes = field(default_factory=lambda: np.zeros((0, STORED, STORED), np.uint8))
    patch_centre: Array = field(default_factory=lambda: np.zeros((0, 2)))
    patch_level: Ints = field(default_factory=lambda: np.zeros(0, np.int64))

    def _reserve(self, n: int) -> None:
        size = len(self.alive)
        if n <= size:
            return
        new = max(4096, 2 * size, n)
        for name in ARRAYS:
            old = getattr(self, name)
            grown = np.zeros((new, *old.shape[1:]), old.dtype)
            grown[:size] = old
            setattr(self, name, grown)

    def add_points(
        self, positions: Array, keyframe: Keyframe, features: Ints, levels: list[Floats]
    ) -> Ints:
        """Add points (M, 3), shown by `features` of a keyframe, whose image `levels` are.

        Returns their ids; observations are added apart.
        """
        seen = keyframe.features
        ids = np.arange(self.n_points, self.n_points + len(positions))
        self._reserve(self.n_points + len(positions))
        self.positions[ids] = positions
        self.descriptors[ids] = seen.descriptors[features]
        self.alive[ids] = True
        self.n_visible[ids] = 1
        self.n_found[ids] = 1
        self.born[ids] = self.first_seen[ids] = keyframe.keyframe_id
        whitening, sigma = seen.whitening[features], seen.sigma_px[features]
        self.first_unproject[ids] = np.linalg.inv(whitening * sigma[:, None, None])
        patches = cut(
            levels, seen.pixels[features].astype(np.float64),
            level_of(seen.octaves[features], self.scale_factor),
        )  # fmt: skip
        self.patch_grey[ids], self.patch_centre[ids] = patches.grey, patches.centre
        self.patch_level[ids] = patches.level
        self.n_points += len(positions)
        return ids

    def take_points(self, other: SlamMap, own_from_other: Similarity) -> int:
        """Take all points of another map; returns what their ids grow by."""
        offset, n = self.n_points, other.n_points
        self._reserve(offset + n)
        for name in ARRAYS:
            getattr(self, name)[offset : offset + n] = getattr(other, name)[:n]
        new = slice(offset, offset + n)
        self.positions[new] = own_from_other.apply(self.positions[new])
        self.normals[new] = self.normals[new] @ own_from_other.rotation.T
        self.base_distance[new] *= own_from_other.scale
        self.n_points += n
        return offset

    def patches_of(self, points: Ints) -> Patches:
        """The patches of some points."""
        return Patches(self.patch_grey[points], self.patch_centre[points], self.patch_level[points])

    def observe(self, keyframe: Keyframe, features: Ints, points: Ints) -> None:
        """Let `keyframe` see `points` with `features`; a feature's earlier point is let go."""
        old = keyframe.point_ids[features]
        np.subtract.at(self.n_observers, old[old >= 0], 1)
        keyframe.point_ids[features] = points
        np.add.at(self.n_observers, points, 1)

    def forget(self, keyframe: Keyframe, features: Ints) -> None:
        """Remove observations of a keyframe; points left with fewer than two are removed."""
        old = keyframe.point_ids[features]
        old = old[old >= 0]
        keyframe.point_ids[features] = -1
        np.subtract.at(self.n_observers, old, 1)
        self.alive[old[self.n_observers[old] < 2]] = False

    def sweep(self, keyframes: list[Keyframe]) -> None:
        """Clear observations of removed points from `keyframes`."""
        for keyframe in keyframes:
            ids = keyframe.point_ids
            dead = (ids >= 0) & ~self.alive[np.maximum(ids, 0)]
            ids[dead] = -1

    def seen_by(self, keyframe: Keyframe) -> tuple[Ints, Ints]:
        """Features and points (same length) of living points that a keyframe sees."""
        ids = keyframe.point_ids
        features = np.flatnonzero((ids >= 0) & self.alive[np.maximum(ids, 0)])
        return features, ids[features]

    def refresh(self, points: Ints, keyframes: list[Keyframe]) -> None:
        """Recompute direction and base distance of `points` from the keyframes that see them.

        Only `keyframes` are looked at; a point's base distance comes from the last of them.
        """
        if len(points) == 0:
            return
        mask = np.zeros(self.n_points, bool)
        mask[points] = True
        total = np.zeros((self.n_points, 3))
        for keyframe in keyframes:
            features, ids = self.seen_by(keyframe)
            chosen = mask[ids]
            features, ids = features[chosen], ids[chosen]
            towards = keyframe.centre - self.positions[ids]
            distance = np.linalg.norm(towards, axis=1)
            total[ids] += towards / np.maximum(distance, 1e-12)[:, None]
            self.base_distance[ids] = (
                distance * self.scale_factor ** keyframe.features.octaves[features]
            )
            self.descriptors[ids] = keyframe.features.descriptors[features]
        norm = np.linalg.norm(total, axis=1)
        ok = points[norm[points] > 0]
        self.normals[ok] = total[ok] / norm[ok][:, None]

    def covisible(self, points: Ints, minimum: int = 15) -> list[tuple[int, int]]:
        """Keyframes that share living `points`: (count, id), most first, older first on a tie."""
        mask = np.zeros(self.n_points + 1, bool)
        mask[points] = True
        mask[:-1] &= self.alive[: self.n_points]
        counts = [
            (int(np.count_nonzero(mask[k.point_ids])), k.keyframe_id)
            for k in self.keyframes.values()
        ]
        return sorted((c for c in counts if c[0] >= minimum), key=lambda c: (-c[0], c[1]))

    def expected_octaves(self, distance: Array, points: Ints) -> Ints:
        """Pyramid level at which each of `points` is seen from `distance`."""
        ratio = self.base_distance[points] / np.maximum(distance, 1e-9)
        level = np.round(np.log(np.maximum(ratio, 1e-9)) / np.log(self.scale_factor))
        return np.asarray(np.clip(level, 0, self.n_levels - 1), np.int64)

    def living_positions(self) -> Array:
        """Positions (M, 3) of all living points."""
        return self.positions[: self.n_points][self.alive[: self.n_points]].copy()
