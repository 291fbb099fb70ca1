"""The sparse map: keyframes, points and observations. Single owner, no locks.

The id of a point is recycled only once nothing can still refer to the old point.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from companion.geometry.pose_table import PoseTable
from companion.geometry.transforms import Array, Pose
from companion.messages import Bytes
from companion.slam.compiled.observing import observed
from companion.slam.features.orb_features import Features, Ints
from companion.slam.map.keyframe_places import KeyframePlaces
from companion.slam.map.map_points import N_OBSERVERS_KEPT, MapPoints
from companion.slam.map.seen import Seen, SeenLater

ID_QUARANTINE_KEYFRAMES = 40
"""Keyframes for which the id of a removed point is not recycled, at least."""
MIN_POINTS_RECYCLED = 200_000
"""Below this number of points the arrays just grow."""
MAX_COVISIBLE_CANDIDATES = 60


@dataclass(slots=True, eq=False)
class Keyframe:
    """A keyframe: `point_ids` (N,) is the map point of each feature, -1 where none."""

    keyframe_id: int
    seq: int
    t_ns: int
    camera_from_map: Pose
    seen: Seen | SeenLater
    point_ids: Ints
    refined_for: Ints
    """Point (N,) whose patch refined each feature, -1 where none did."""
    grey: Bytes | None = None
    """Image (H, W), while patch alignment may still use it."""
    ned_from_camera: Array | None = None
    """Attitude (3, 3) by the autopilot, where measured."""
    is_far: bool = False
    """Left behind: what it saw, and the patches of its points, may lie in a file."""

    @property
    def features(self) -> Features:
        """Features as they were found."""
        return self.seen.features

    @property
    def normalised(self) -> Array:
        """Ideal coordinates (N, 2), refined where patch alignment succeeded."""
        return self.seen.normalised

    @property
    def whitening(self) -> Array:
        """Whitening (N, 2, 2) of `normalised`."""
        return self.seen.whitening

    @property
    def seen_apart(self) -> Seen | SeenLater:
        """The same for a copy of the keyframe, to be refined apart: one left behind never is."""
        return self.seen if isinstance(self.seen, SeenLater) or self.is_far else self.seen.copied()

    @property
    def centre(self) -> Array:
        """Position of the camera in the map (3,)."""
        out: Array = -self.camera_from_map.rotation.T @ self.camera_from_map.translation
        return out


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
class SlamMap(MapPoints):
    """All keyframes and points. Arrays are over-allocated; the first `n_points` rows are in use."""

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
    _places: KeyframePlaces = field(default_factory=KeyframePlaces)
    _quarantined_ids: Ints = field(default_factory=lambda: np.zeros(0, np.int32))
    _quarantine_age: int = 0

    def leave_behind(self, keyframe: Keyframe) -> None:
        """Let ids that a keyframe names be as they are, and refine its features no more.

        It names none but those of living points, whose rows would else never be used again.
        """
        self.clear_dead_observations([keyframe])
        keyframe.point_ids = ids = keyframe.point_ids.astype(np.int32)
        keyframe.refined_for = np.where(keyframe.refined_for == ids, ids, -1)
        keyframe.is_far, keyframe.grey = True, None
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
        free = np.sort(np.concatenate([self._free_ids, self._quarantined_ids]))
        known[free] = True
        dead = np.r_[~known, False]
        for keyframe in self.keyframes.values():
            if keyframe.is_far:
                continue
            for ids in (keyframe.point_ids, keyframe.refined_for):
                ids[dead[ids]] = -1
        self._free_ids, self._quarantined_ids = free, np.flatnonzero(~known).astype(np.int32)

    def add_observations(self, keyframe: Keyframe, features: Ints, points: Ints) -> None:
        """Let `keyframe` observe `points` with `features`, replacing earlier observations."""
        old = keyframe.point_ids[features]
        np.subtract.at(self.n_observers, old[old >= 0], 1)
        keyframe.point_ids[features] = points
        self.observers[points, self.n_observers[points] % N_OBSERVERS_KEPT] = keyframe.keyframe_id
        np.add.at(self.n_observers, points, 1)
        self.is_named[points] |= keyframe.is_far

    def move_observation(self, keyframe: Keyframe, feature: int, point: int) -> None:
        """As `add_observations` of one feature that observes another point until now."""
        self.n_observers[keyframe.point_ids[feature]] -= 1
        keyframe.point_ids[feature] = point
        self.observers[point, self.n_observers[point] % N_OBSERVERS_KEPT] = keyframe.keyframe_id
        self.n_observers[point] += 1
        self.is_named[point] |= keyframe.is_far

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
            ids[~self.alive[ids]] = -1  # the last row is that of no point

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
