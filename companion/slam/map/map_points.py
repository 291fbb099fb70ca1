"""The points of a map, in growing arrays, so that per-frame work is vectorised."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from companion.geometry.transforms import Array, Similarity
from companion.messages import Bytes
from companion.slam.features.orb_features import Bools, Features, Ints
from companion.slam.features.patches import Patches, cut, level_of
from companion.slam.map.patch_store import NO_PATCH, PatchRows, PatchStore

N_OBSERVERS_KEPT = 8
ARRAYS = (
    "observers", "positions", "alive", "descriptors", "normals", "base_distance", "n_visible",
    "n_found", "n_observers", "born", "first_seen", "first_unproject", "patch_at", "patch_centre",
    "patch_level", "is_named", "_number", "_marked",
)  # fmt: skip


class PointArrays(NamedTuple):
    """N points of a map without their observations; fields as those of `MapPoints`."""

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
    patch_grey: PatchRows


@dataclass(slots=True, eq=False)
class MapPoints:
    """Points by id, the index of their row; the first `n_points` rows are in use.

    Types are as narrow as they may be: a flight of an hour leaves near a million points.
    """

    scale_factor: float
    n_levels: int
    n_points: int = 0
    positions: Array = field(default_factory=lambda: np.zeros((0, 3)))
    alive: Bools = field(default_factory=lambda: np.zeros(0, bool))
    descriptors: Bytes = field(default_factory=lambda: np.zeros((0, 32), np.uint8))
    normals: Array = field(default_factory=lambda: np.zeros((0, 3)))
    """Mean viewing direction (P, 3), from point to camera."""
    base_distance: Array = field(default_factory=lambda: np.zeros(0))
    """Distance (P,) at which the point would be detected at pyramid level 0, map units."""
    n_visible: Ints = field(default_factory=lambda: np.zeros(0, np.int32))
    n_found: Ints = field(default_factory=lambda: np.zeros(0, np.int32))
    n_observers: Ints = field(default_factory=lambda: np.zeros(0, np.int32))
    observers: Ints = field(default_factory=lambda: np.zeros((0, N_OBSERVERS_KEPT), np.int32))
    """Ids of the latest keyframes to observe the point, unordered, -1 padded; may be outdated."""
    born: Ints = field(default_factory=lambda: np.zeros(0, np.int32))
    """Id (P,) of the keyframe at which the point was created."""
    first_seen: Ints = field(default_factory=lambda: np.zeros(0, np.int32))
    """Id (P,) of the keyframe with the reference view of the patch."""
    first_unproject: Array = field(default_factory=lambda: np.zeros((0, 2, 2)))
    """Jacobian of the reference view's normalised coordinates by its pixels"""
    patch_at: Ints = field(default_factory=lambda: np.zeros(0, np.int32))
    """Number (P,) of a point's patch, while the point is alive."""
    patch_centre: Array = field(default_factory=lambda: np.zeros((0, 2)))
    patch_level: Ints = field(default_factory=lambda: np.zeros(0, np.int8))
    is_named: Bools = field(default_factory=lambda: np.zeros(0, bool))
    """Points (P,) that far keyframes name, dead or alive: their ids are not recycled."""
    _number: Ints = field(default_factory=lambda: np.zeros(0, np.int32))
    """Of some points (P,) from 1 on, while these are looked at; else 0."""
    _marked: Bools = field(default_factory=lambda: np.zeros(0, bool))
    """Some points (P,), while these are looked at."""
    patches: PatchStore = field(default_factory=PatchStore)
    _free_ids: Ints = field(default_factory=lambda: np.zeros(0, np.int32))
    """Point ids to recycle, the highest last: those of one place lie together."""

    def _reserve(self, n: int) -> None:
        size = len(self.alive)
        if n < size:  # the last row is that of no point
            return
        new = max(4096, 2 * size, n + 1)
        for name in ARRAYS:
            old = getattr(self, name)
            grown = np.zeros((new, *old.shape[1:]), old.dtype)
            grown[:size] = old
            setattr(self, name, grown)

    def add_points(
        self, positions: Array, keyframe_id: int, seen: Features, features: Ints,
        levels: list[Bytes],
    ) -> Ints:  # fmt: skip
        """Add points (M, 3) that are `features` of a keyframe, which has `seen` others too.

        `levels` is the pyramid of its image. Returns their ids; observations are added separately.
        """
        n_left = max(len(self._free_ids) - len(positions), 0)
        self._free_ids, again = np.split(self._free_ids, [n_left])
        n_more = len(positions) - len(again)
        fresh = np.arange(self.n_points, self.n_points + n_more)
        ids: Ints = np.concatenate([again[::-1], fresh])
        self._reserve(self.n_points + n_more)
        self.n_observers[ids] = 0
        self.positions[ids] = positions
        self.descriptors[ids] = seen.descriptors[features]
        self.alive[ids] = True
        self.observers[ids] = -1
        self.n_visible[ids] = 1
        self.n_found[ids] = 1
        self.born[ids] = self.first_seen[ids] = keyframe_id
        whitening, sigma = seen.whitening[features], seen.sigma_px[features]
        self.first_unproject[ids] = np.linalg.inv(whitening * sigma[:, None, None])
        patches = cut(
            levels, seen.pixels[features].astype(np.float64),
            level_of(seen.octaves[features], self.scale_factor),
        )  # fmt: skip
        self.patch_at[ids] = self.patches.add(patches.grey)
        self.patch_centre[ids] = patches.centre
        self.patch_level[ids] = patches.level
        self.n_points += n_more
        return ids

    def free_patches(self) -> None:
        """Release the patches of removed points."""
        n = self.n_points
        dead = np.flatnonzero(~self.alive[:n] & (self.patch_at[:n] != NO_PATCH))
        self.patches.free(self.patch_at[dead])
        self.patch_at[dead] = self.patch_level[dead] = NO_PATCH

    def put_patches_away(self, ids: Ints, grey: Bytes) -> None:
        """Keep the patches of points in an array of equal ones, which may lie in a file."""
        self.patch_at[ids] = self.patches.put_away(self.patch_at[ids], grey)

    def append_points(self, other: MapPoints, own_from_other: Similarity) -> int:
        """Append all points of another map; returns the offset added to their ids."""
        offset, n = self.n_points, other.n_points
        self._reserve(offset + n)
        for name in ARRAYS:
            getattr(self, name)[offset : offset + n] = getattr(other, name)[:n]
        new = slice(offset, offset + n)
        self.positions[new] = own_from_other.apply(self.positions[new])
        self.normals[new] = self.normals[new] @ own_from_other.rotation.T
        self.base_distance[new] *= own_from_other.scale
        self.n_points += n
        self.patch_at[new] = self.patches.take_over(other.patches, other.patch_at[:n])
        return offset

    def load_points(self, points: PointArrays, is_far: bool = False) -> None:
        """Load stored points (see `points_of`) into an empty map; of far ones the patches stay."""
        n = len(points.positions)
        self._reserve(n)
        self.n_points = n
        every = slice(0, n)
        for name, values in points._asdict().items():
            if name != "patch_grey":
                getattr(self, name)[every] = values
        self.alive[every] = True
        self.observers[every] = -1
        if is_far:
            self.patch_at[every] = self.patches.put_away(np.full(n, NO_PATCH), points.patch_grey)
        else:
            self.patch_at[every] = self.patches.add(points.patch_grey[every])

    def points_of(self, ids: Ints) -> PointArrays:
        """Copies of the data of living points, without their observations."""
        rows = [getattr(self, name)[ids] for name in PointArrays._fields[:-1]]
        return PointArrays._make([*rows, self.patches.of(self.patch_at[ids])])

    def patches_of(self, points: Ints) -> Patches:
        """The patches of some points."""
        return Patches(
            self.patches.of(self.patch_at[points]),
            self.patch_centre[points],
            self.patch_level[points],
        )

    def point_positions(self) -> Array:
        """Positions (M, 3) of all living points."""
        return self.positions[: self.n_points][self.alive[: self.n_points]]
