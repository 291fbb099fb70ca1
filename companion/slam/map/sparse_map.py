"""The sparse map: keyframes, points and observations. Single owner, no locks.

Points live in growing arrays, so that per-frame work is vectorised. The index of a point is its id;
an id is recycled only once nothing can still refer to the old point.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.geometry.pose_table import PoseTable
from companion.geometry.transforms import Array, Pose, Similarity
from companion.messages import Bytes
from companion.slam.compiled.observing import observed
from companion.slam.features.orb_features import Bools, Features, Ints
from companion.slam.features.patches import Patches, cut, level_of
from companion.slam.map.keyframe_places import KeyframePlaces
from companion.slam.map.patch_store import NO_PATCH, PatchStore

N_OBSERVERS_KEPT = 8
ID_QUARANTINE_KEYFRAMES = 40
"""Keyframes for which the id of a removed point is not recycled, at least."""
MIN_POINTS_RECYCLED = 200_000
"""Below this number of points the arrays just grow."""
MAX_COVISIBLE_CANDIDATES = 60
ARRAYS = (
    "observers", "positions", "alive", "descriptors", "normals", "base_distance", "n_visible",
    "n_found", "n_observers", "born", "first_seen", "first_unproject", "patch_at", "patch_centre",
    "patch_level", "is_named", "_number", "_marked",
)  # fmt: skip


@dataclass(slots=True, eq=False)
class Keyframe:
    """A keyframe: `point_ids` (N,) is the map point of each feature, -1 where none."""

    keyframe_id: int
    seq: int
    t_ns: int
    camera_from_map: Pose
    features: Features
    point_ids: Ints
    normalised: Array
    whitening: Array
    """(N, 2), (N, 2, 2) as those of the features, refined where patch alignment succeeded."""
    refined_for: Ints
    """Point (N,) whose patch refined each feature, -1 where none did."""
    grey: Bytes | None = None
    """Image (H, W), while patch alignment may still use it."""
    ned_from_camera: Array | None = None
    """Attitude (3, 3) by the autopilot, where measured."""
    is_far: bool = False
    """Left behind: features, their refinement and the patches of its points may lie in a file."""

    @property
    def centre(self) -> Array:
        """Position of the camera in the map (3,)."""
        out: Array = -self.camera_from_map.rotation.T @ self.camera_from_map.translation
        return out


class PointArrays(NamedTuple):
    """N points of a map without their observations; fields as those of `SlamMap`."""

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
    """Pose of a culled keyframe relative to its anchor, a keyframe still in the map; map units."""

    anchor_id: int
    anchor_from_camera: Pose

    def scaled(self, scale: float) -> Retired:
        """The same after the map's unit has changed."""
        pose = self.anchor_from_camera
        return Retired(self.anchor_id, Pose(pose.rotation, scale * pose.translation))


@dataclass(slots=True, eq=False)
class SlamMap:
    """All keyframes and points. Arrays are over-allocated; the first `n_points` rows are in use."""

    scale_factor: float
    n_levels: int
    first_keyframe_id: int = -1
    """Identifies the map among others; -1 before initialisation."""
    level: bool = False
    """True if the z axis is gravity-aligned (down)."""
    keyframes: dict[int, Keyframe] = field(default_factory=dict)
    """Ordered by id."""
    retired: dict[int, Retired] = field(default_factory=dict)
    """Culled keyframes by id; frames and chunks of the cloud may still refer to them."""
    unit_of: dict[int, float] = field(default_factory=dict)
    """Map units per unit of what was reported about a keyframe at its creation, where not 1."""
    held: frozenset[int] = frozenset()
    """Keyframes of an earlier flight, in whose frame the others are placed: nothing moves them."""
    n_points: int = 0
    positions: Array = field(default_factory=lambda: np.zeros((0, 3)))
    alive: Bools = field(default_factory=lambda: np.zeros(0, bool))
    descriptors: Bytes = field(default_factory=lambda: np.zeros((0, 32), np.uint8))
    normals: Array = field(default_factory=lambda: np.zeros((0, 3)))
    """Mean viewing direction (P, 3), from point to camera."""
    base_distance: Array = field(default_factory=lambda: np.zeros(0))
    """Distance (P,) at which the point would be detected at pyramid level 0, map units."""
    n_visible: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    n_found: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    n_observers: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    observers: Ints = field(default_factory=lambda: np.zeros((0, N_OBSERVERS_KEPT), np.int64))
    """Ids of the latest keyframes to observe the point, unordered, -1 padded; may be outdated."""
    born: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    """Id (P,) of the keyframe at which the point was created."""
    first_seen: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    """Id (P,) of the keyframe with the reference view of the patch."""
    _places: KeyframePlaces = field(default_factory=KeyframePlaces)
    first_unproject: Array = field(default_factory=lambda: np.zeros((0, 2, 2)))
    """Jacobian of the reference view's normalised coordinates by its pixels"""
    patch_at: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    """Number (P,) of a point's patch, while the point is alive."""
    patch_centre: Array = field(default_factory=lambda: np.zeros((0, 2)))
    patch_level: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    is_named: Bools = field(default_factory=lambda: np.zeros(0, bool))
    """Points (P,) that far keyframes name, dead or alive: their ids are not recycled."""
    _number: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    """Of some points (P,) from 1 on, while these are looked at; else 0."""
    _marked: Bools = field(default_factory=lambda: np.zeros(0, bool))
    """Some points (P,), while these are looked at."""
    patches: PatchStore = field(default_factory=PatchStore)
    _free_ids: list[int] = field(default_factory=list)
    """Point ids to recycle, the highest last: those of one place lie together."""
    _quarantined_ids: list[int] = field(default_factory=list)
    _quarantine_age: int = 0

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
        self, positions: Array, keyframe: Keyframe, features: Ints, levels: list[Bytes]
    ) -> Ints:
        """Add points (M, 3) seen by `features` of a keyframe, whose image pyramid is `levels`.

        Returns their ids; observations are added separately.
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

    def leave_behind(self, keyframe: Keyframe) -> None:
        """Let ids that a keyframe names be as they are, and refine its features no more."""
        keyframe.is_far, keyframe.grey = True, None
        for ids in (keyframe.point_ids, keyframe.refined_for):
            self.is_named[ids[ids >= 0]] = True

    def recycle_ids(self) -> None:
        """Recycle ids of points removed long ago; called once per keyframe."""
        self._quarantine_age += 1
        if self._quarantine_age < ID_QUARANTINE_KEYFRAMES or self.n_points < MIN_POINTS_RECYCLED:
            return
        self._quarantine_age = 0
        n = self.n_points
        known = self.alive[:n].copy()
        known |= self.is_named[:n]
        known[self._free_ids + self._quarantined_ids] = True
        dead = np.r_[~known, False]
        for keyframe in self.keyframes.values():
            if keyframe.is_far:
                continue
            for ids in (keyframe.point_ids, keyframe.refined_for):
                ids[dead[ids]] = -1
        self._free_ids = sorted(self._free_ids + self._quarantined_ids)
        self._quarantined_ids = np.flatnonzero(~known).tolist()

    def append_points(self, other: SlamMap, own_from_other: Similarity) -> int:
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
        held = np.flatnonzero(other.patch_at[:n] != NO_PATCH)
        self.patch_at[offset + held] = self.patches.add(other.patches.of(other.patch_at[held]))
        return offset

    def load_points(self, points: PointArrays) -> None:
        """Load stored points (see `points_of`) into an empty map."""
        n = len(points.positions)
        self._reserve(n)
        self.n_points = n
        every = slice(0, n)
        for name, values in points._asdict().items():
            if name != "patch_grey":
                getattr(self, name)[every] = values
        self.alive[every] = True
        self.observers[every] = -1
        self.patch_at[every] = self.patches.add(points.patch_grey)

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

    def add_observations(self, keyframe: Keyframe, features: Ints, points: Ints) -> None:
        """Let `keyframe` observe `points` with `features`, replacing earlier observations."""
        old = keyframe.point_ids[features]
        np.subtract.at(self.n_observers, old[old >= 0], 1)
        keyframe.point_ids[features] = points
        self.observers[points, self.n_observers[points] % N_OBSERVERS_KEPT] = keyframe.keyframe_id
        np.add.at(self.n_observers, points, 1)

    def move_observation(self, keyframe: Keyframe, feature: int, point: int) -> None:
        """As `add_observations` of one feature that observes another point until now."""
        self.n_observers[keyframe.point_ids[feature]] -= 1
        keyframe.point_ids[feature] = point
        self.observers[point, self.n_observers[point] % N_OBSERVERS_KEPT] = keyframe.keyframe_id
        self.n_observers[point] += 1

    def remove_observations(self, keyframe: Keyframe, features: Ints) -> None:
        """Remove observations of a keyframe; points left with fewer than two are removed."""
        old = keyframe.point_ids[features]
        old = old[old >= 0]
        keyframe.point_ids[features] = -1
        np.subtract.at(self.n_observers, old, 1)
        self.alive[old[self.n_observers[old] < 2]] = False

    def clear_dead_observations(self, keyframes: list[Keyframe]) -> None:
        """Clear observations of removed points from `keyframes`."""
        for keyframe in keyframes:
            ids = keyframe.point_ids
            dead = (ids >= 0) & ~self.alive[np.maximum(ids, 0)]
            ids[dead] = -1

    def observations_of(self, keyframe: Keyframe) -> tuple[Ints, Ints]:
        """Features and living points (same length) that a keyframe observes."""
        return observed(keyframe.point_ids, self.alive)

    def update_geometry(self, points: Ints, keyframes: list[Keyframe]) -> None:
        """Recompute viewing direction and base distance of `points` from `keyframes`.

        The base distance of a point comes from the last keyframe that observes it.
        """
        if len(points) == 0:
            return
        number = self._number
        number[points] = np.arange(1, len(points) + 1)
        total = np.zeros((len(points), 3))
        for keyframe in keyframes:
            features, ids = self.observations_of(keyframe)
            chosen = number[ids] > 0
            features, ids = features[chosen], ids[chosen]
            towards = keyframe.centre - self.positions[ids]
            distance = np.linalg.norm(towards, axis=1)
            total[number[ids] - 1] += towards / np.maximum(distance, 1e-12)[:, None]
            self.base_distance[ids] = (
                distance * self.scale_factor ** keyframe.features.octaves[features]
            )
            self.descriptors[ids] = keyframe.features.descriptors[features]
        number[points] = 0
        norm = np.linalg.norm(total, axis=1)
        known = norm > 0
        self.normals[points[known]] = total[known] / norm[known][:, None]

    def covisible(self, points: Ints, minimum: int = 15) -> list[tuple[int, int]]:
        """Keyframes that share living `points`: (count, id), most first, older first where equal.

        Only candidates that are frequent among the latest observers of the points are counted.
        """
        points = points[self.alive[points]]
        self._marked[points] = True
        observations_of = self.observers[points].ravel()
        keys, often = np.unique(observations_of[observations_of >= 0], return_counts=True)
        order = np.lexsort((keys, -often))[:MAX_COVISIBLE_CANDIDATES]
        near = [self.keyframes[k] for k in keys[order].tolist() if k in self.keyframes]
        counts = [(int(np.count_nonzero(self._marked[k.point_ids])), k.keyframe_id) for k in near]
        self._marked[points] = False
        return sorted((c for c in counts if c[0] >= minimum), key=lambda c: (-c[0], c[1]))

    def pose_of(self, keyframe_id: int) -> Pose | None:
        """`camera_from_map` of a keyframe, culled or not; None if unknown."""
        keyframe = self.keyframes.get(keyframe_id)
        if keyframe is not None:
            return keyframe.camera_from_map
        retired = self.retired.get(keyframe_id)
        if retired is None:
            return None
        anchor = self.keyframes[retired.anchor_id].camera_from_map
        return retired.anchor_from_camera.inverse() @ anchor

    def poses(self) -> PoseTable:
        """`map_from_camera` of every keyframe, culled ones included."""
        living = self._places.poses(self.keyframes).inverse()
        if not self.retired:
            return living
        anchors = np.array([each.anchor_id for each in self.retired.values()], np.int64)
        apart = PoseTable.of({key: r.anchor_from_camera for key, r in self.retired.items()})
        return PoseTable.joined([living, living.followed_by(anchors, apart)])

    def keyframes_moved(self, ids: Iterable[int] | None = None) -> None:
        """To be called after keyframes were added, moved or removed: some, or any."""
        self._places.move(ids)

    def nearest(self, centre: Array, n: int, exclude: set[int]) -> list[int]:
        """Ids of the `n` keyframes nearest to a position (3,), without those in `exclude`."""
        return self._places.nearest(self.keyframes, centre, n, exclude)

    def centres(self, first: int, last: int) -> Array:
        """Centres (K, 3) of the keyframes from one id to another, in order."""
        return self._places.centres(self.keyframes, first, last)

    def spread_keyframes(self, most: int) -> list[Keyframe]:
        """All keyframes in order, or so many of them spread over the flight."""
        keyframes = list(self.keyframes.values())
        if len(keyframes) <= most:
            return keyframes
        return [keyframes[int(i)] for i in np.linspace(0, len(keyframes) - 1, most).astype(int)]

    def positions_about_newest(self, n_keyframes: int) -> Array:
        """Positions (M, 3) of points that the keyframes nearest to the newest one observe."""
        newest = self.keyframes[next(reversed(self.keyframes))]
        near = np.zeros(self.n_points, bool)
        for key in self.nearest(newest.centre, n_keyframes, set()):
            near[self.observations_of(self.keyframes[key])[1]] = True
        return self.positions[: self.n_points][near]

    def point_positions(self) -> Array:
        """Positions (M, 3) of all living points."""
        return self.positions[: self.n_points][self.alive[: self.n_points]]
