"""The sparse map: keyframes, points, and who sees what. One owner, no locks.

Points live in growing arrays so that a frame's work is a few vector operations; a point's index is
its identity for as long as it lives, and is not used again before nobody can still know of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from companion.geometry.transforms import Array, Pose, Similarity
from companion.messages import Bytes
from companion.slam.compiled.patch_alignment import STORED
from companion.slam.features.orb_features import Bools, Features, Ints
from companion.slam.features.patches import Patches, cut, level_of

RING = 8
REST_KEYFRAMES = 40
"""The index of a point that died is not used again for at least as many."""
MANY_POINTS = 200_000
"""Arrays shorter than this cost nothing: they may as well grow."""
CANDIDATES = 60
ARRAYS = (
    "observers", "positions", "alive", "descriptors", "normals", "base_distance", "n_visible",
    "n_found", "n_observers", "born", "first_seen", "first_unproject", "patch_at", "patch_centre",
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
    ned_from_camera: Array | None = None
    """(3, 3) by the autopilot, where it told"""

    @property
    def centre(self) -> Array:
        """Position of the camera in the map."""
        out: Array = -self.camera_from_map.rotation.T @ self.camera_from_map.translation
        return out


class PointArrays(NamedTuple):
    """N points of a map, but for who sees them; each field is as that of `SlamMap`."""

    positions: Array
    descriptors: Bytes
    normals: Array
    base_distance: Array
    n_visible: Ints
    n_found: Ints
    born: Ints
    first_seen: Ints
    first_unproject: Array
    patch_centre: Array
    patch_level: Ints
    patch_grey: Bytes


@dataclass(frozen=True, slots=True, eq=False)
class Retired:
    """Where a keyframe that went is: beside one that stayed, in map units."""

    beside_id: int
    beside_from_camera: Pose

    def scaled(self, scale: float) -> Retired:
        """The same where the map's unit is another."""
        pose = self.beside_from_camera
        return Retired(self.beside_id, Pose(pose.rotation, scale * pose.translation))


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
    retired: dict[int, Retired] = field(default_factory=dict)
    """Keyframes that went, by their ids; frames and parts of the cloud may still hang on them."""
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
    observers: Ints = field(default_factory=lambda: np.zeros((0, RING), np.int64))
    """the keyframes that came to see it last, in no order, -1 where fewer; may be out of date"""
    born: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    """keyframe id at which the point was made"""
    first_seen: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    """keyframe id of the view that the patch is from"""
    _centres: Array | None = None
    _ids: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    first_unproject: Array = field(default_factory=lambda: np.zeros((0, 2, 2)))
    """derivative of that view's normalised coordinates by its pixels"""
    patch_at: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    """place of a point's patch in `patch_grey`, for as long as the point lives"""
    patch_centre: Array = field(default_factory=lambda: np.zeros((0, 2)))
    patch_level: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    patch_grey: Bytes = field(default_factory=lambda: np.zeros((0, STORED, STORED), np.uint8))
    _free: list[int] = field(default_factory=list)
    """places of patches whose points have died"""
    _free_ids: list[int] = field(default_factory=list)
    """indices to use again, the lowest last"""
    _resting_ids: list[int] = field(default_factory=list)
    _rests: int = 0

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
        self, positions: Array, keyframe: Keyframe, features: Ints, levels: list[Bytes]
    ) -> Ints:
        """Add points (M, 3), shown by `features` of a keyframe, whose image `levels` are.

        Returns their ids; observations are added apart.
        """
        seen = keyframe.features
        again = [self._free_ids.pop() for _ in range(min(len(positions), len(self._free_ids)))]
        n_more = len(positions) - len(again)
        fresh = np.arange(self.n_points, self.n_points + n_more)
        ids: Ints = np.concatenate([np.array(again, np.int64), fresh])
        self._reserve(self.n_points + n_more)
        self.n_observers[ids] = 0
        self.positions[ids] = positions
        self.descriptors[ids] = seen.descriptors[features]
        self.alive[ids] = True
        self.observers[ids] = -1
        self.n_visible[ids] = 1
        self.n_found[ids] = 1
        self.born[ids] = self.first_seen[ids] = keyframe.keyframe_id
        whitening, sigma = seen.whitening[features], seen.sigma_px[features]
        self.first_unproject[ids] = np.linalg.inv(whitening * sigma[:, None, None])
        patches = cut(
            levels, seen.pixels[features].astype(np.float64),
            level_of(seen.octaves[features], self.scale_factor),
        )  # fmt: skip
        self._store(ids, patches.grey)
        self.patch_centre[ids] = patches.centre
        self.patch_level[ids] = patches.level
        self.n_points += n_more
        return ids

    def _store(self, ids: Ints, grey: Bytes) -> None:
        """Keep the patches of new points, in place of dead ones' where there are any."""
        missing = len(ids) - len(self._free)
        if missing > 0:
            size = len(self.patch_grey)
            new = max(4096, size // 2, missing)
            grown = np.zeros((size + new, STORED, STORED), np.uint8)
            grown[:size] = self.patch_grey
            self.patch_grey = grown
            self._free += range(size + new - 1, size - 1, -1)
        self.patch_at[ids] = [self._free.pop() for _ in range(len(ids))]
        self.patch_grey[self.patch_at[ids]] = grey

    def bury(self) -> None:
        """Let go of what dead points held."""
        dead = np.flatnonzero(~self.alive[: self.n_points] & (self.patch_at[: self.n_points] >= 0))
        self._free += self.patch_at[dead].tolist()
        self.patch_at[dead] = self.patch_level[dead] = -1

    def reclaim(self) -> None:
        """Let indices of points that died long ago be used again; called for each keyframe."""
        self._rests += 1
        if self._rests < REST_KEYFRAMES or self.n_points < MANY_POINTS:
            return
        self._rests = 0
        n = self.n_points
        known = self.alive[:n].copy()
        known[self._free_ids + self._resting_ids] = True
        dead = np.r_[~known, False]
        for keyframe in self.keyframes.values():
            for ids in (keyframe.point_ids, keyframe.refined_for):
                ids[dead[ids]] = -1
        self._free_ids = sorted(self._free_ids + self._resting_ids, reverse=True)
        self._resting_ids = np.flatnonzero(~known).tolist()

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
        held = np.flatnonzero(other.patch_at[:n] >= 0)
        self._store(offset + held, other.patch_grey[other.patch_at[held]])
        return offset

    def put_points(self, points: PointArrays) -> None:
        """Take points that were kept (see `points_of`) into a map that has none yet."""
        n = len(points.positions)
        self._reserve(n)
        self.n_points = n
        every = slice(0, n)
        for name, values in points._asdict().items():
            if name != "patch_grey":
                getattr(self, name)[every] = values
        self.alive[every] = True
        self.observers[every] = -1
        self._store(np.arange(n), points.patch_grey)

    def points_of(self, ids: Ints) -> PointArrays:
        """Copies of what is known of points that live, but for who sees them."""
        rows = [getattr(self, name)[ids] for name in PointArrays._fields[:-1]]
        return PointArrays._make([*rows, self.patch_grey[self.patch_at[ids]]])

    def patches_of(self, points: Ints) -> Patches:
        """The patches of some points."""
        return Patches(
            self.patch_grey[self.patch_at[points]],
            self.patch_centre[points],
            self.patch_level[points],
        )

    def observe(self, keyframe: Keyframe, features: Ints, points: Ints) -> None:
        """Let `keyframe` see `points` with `features`; a feature's earlier point is let go."""
        old = keyframe.point_ids[features]
        np.subtract.at(self.n_observers, old[old >= 0], 1)
        keyframe.point_ids[features] = points
        self.observers[points, self.n_observers[points] % RING] = keyframe.keyframe_id
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
        place = np.full(self.n_points, -1, np.int32)
        place[points] = np.arange(len(points))
        total = np.zeros((len(points), 3))
        for keyframe in keyframes:
            features, ids = self.seen_by(keyframe)
            chosen = place[ids] >= 0
            features, ids = features[chosen], ids[chosen]
            towards = keyframe.centre - self.positions[ids]
            distance = np.linalg.norm(towards, axis=1)
            total[place[ids]] += towards / np.maximum(distance, 1e-12)[:, None]
            self.base_distance[ids] = (
                distance * self.scale_factor ** keyframe.features.octaves[features]
            )
            self.descriptors[ids] = keyframe.features.descriptors[features]
        norm = np.linalg.norm(total, axis=1)
        known = norm > 0
        self.normals[points[known]] = total[known] / norm[known][:, None]

    def covisible(self, points: Ints, minimum: int = 15) -> list[tuple[int, int]]:
        """Keyframes that share living `points`: (count, id), most first, older first on a tie.

        Only those are looked at that are among the last to have come to see many of the points.
        """
        points = points[self.alive[points]]
        mask = np.zeros(self.n_points + 1, bool)
        mask[points] = True
        seen_by = self.observers[points].ravel()
        keys, often = np.unique(seen_by[seen_by >= 0], return_counts=True)
        order = np.lexsort((keys, -often))[:CANDIDATES]
        near = [self.keyframes[k] for k in keys[order].tolist() if k in self.keyframes]
        counts = [(int(np.count_nonzero(mask[k.point_ids])), k.keyframe_id) for k in near]
        return sorted((c for c in counts if c[0] >= minimum), key=lambda c: (-c[0], c[1]))

    def pose_of(self, keyframe_id: int) -> Pose | None:
        """`camera_from_map` of a keyframe, be it one that went; None where there is no such."""
        keyframe = self.keyframes.get(keyframe_id)
        if keyframe is not None:
            return keyframe.camera_from_map
        retired = self.retired.get(keyframe_id)
        if retired is None:
            return None
        beside = self.keyframes[retired.beside_id].camera_from_map
        return retired.beside_from_camera.inverse() @ beside

    def places(self) -> Iterator[tuple[int, Pose]]:
        """Every keyframe's id and `map_from_camera`, those that went among them."""
        living = {key: k.camera_from_map.inverse() for key, k in self.keyframes.items()}
        yield from living.items()
        for key, retired in self.retired.items():
            yield key, living[retired.beside_id] @ retired.beside_from_camera

    def poses_changed(self) -> None:
        """Tell the map that keyframes have come or moved."""
        self._centres = None

    def nearest(self, centre: Array, n: int, but: set[int]) -> list[int]:
        """Ids of the `n` keyframes nearest to a place (3,) that are not in `but`."""
        if self._centres is None:
            self._centres = np.stack([k.centre for k in self.keyframes.values()])
            self._ids = np.array(list(self.keyframes))
        apart = np.linalg.norm(self._centres - centre, axis=1)
        order = np.argsort(apart, kind="stable")[: n + len(but)]
        return [k for k in self._ids[order].tolist() if k not in but][:n]

    def living_positions(self) -> Array:
        """Positions (M, 3) of all living points."""
        return self.positions[: self.n_points][self.alive[: self.n_points]].copy()
