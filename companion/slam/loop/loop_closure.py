"""Loop detection: the similarity between the surroundings of a keyframe and another part.

A keyframe is relocalised in an older part of its map, or in another map; its neighbours must then
confirm the similarity, which rejects repetitive facades and fields.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from companion.geometry.transforms import Array, Pose, Similarity, angle_between
from companion.messages import Georeference
from companion.slam.loop.place_recognition import KeyframeDatabase
from companion.slam.loop.relocalizer import (
    LOW_FOUND_RATIO,
    MIN_FOUND,
    MIN_FOUND_RATIO,
    Relocalised,
    Relocalizer,
)
from companion.slam.map.sparse_map import Keyframe, SlamMap

N_CANDIDATES = 4
N_NEIGHBOURS, MIN_CONFIRMING = 3, 2
MIN_SHARED = 20
"""Features that observe a point of both parts, for the relative scale."""
MAX_SCALE_SPREAD = 0.08
MAX_TILT_RAD = np.radians(10.0)
"""Each map was levelled by an attitude that may be degrees off, with a heading of its own."""
MAX_SCALE_DRIFT = 1.6
RECENT = 8
"""Newest keyframes that are no loop candidates."""
N_NEAR, OTHER_PASS, SAME_VIEW = 60, 20, 0.8
"""Of the keyframes nearest to one, those that are so many ids away, whose optical axis is turned by
less than this cosine (37 degrees, where descriptors begin to differ), show it in another pass."""


@dataclass(frozen=True, slots=True, eq=False)
class LoopClosure:
    """A keyframe relocalised in another map, or in an older part of its own.

    `here_from_there` takes coordinates of that part to those of the map of the keyframe.
    """

    keyframe: Keyframe
    there: SlamMap
    relocalised: Relocalised
    here_from_there: Similarity


PlaceOf = Callable[[SlamMap], Georeference | None]
LoopCheck = Callable[[LoopClosure, bool], bool]
"""Test of a loop closure by other measurements; its second argument is True within one map."""


class LoopDetector:
    """Searches loop closures of new keyframes with all older ones."""

    def __init__(self, database: KeyframeDatabase, relocalizer: Relocalizer) -> None:
        self._database = database
        self._relocalizer = relocalizer

    def find(
        self, keyframe: Keyframe, here: SlamMap, maps: list[SlamMap], check: LoopCheck,
        yield_point: Callable[[], None] = lambda: None,
    ) -> LoopClosure | None:  # fmt: skip
        """A confirmed loop closure, or None. `yield_point` is called before each candidate."""
        _, ids = here.observations_of(keyframe)
        near = {k for _, k in here.covisible(ids, 8)} | set(sorted(here.keyframes)[-RECENT:])
        for key in self._candidates(keyframe, near, here, maps):
            yield_point()
            there = next((m for m in maps if key in m.keyframes), None)
            if there is None:
                continue
            found = self._try(keyframe, here, there.keyframes[key], there)
            if found is not None and check(found, here is there):
                return found
        return None

    def find_near(self, keyframe: Keyframe, here: SlamMap, check: LoopCheck) -> LoopClosure | None:
        """A confirmed loop closure with a pass nearby that shares no point, or None.

        Most places of a flight over fields or roofs look alike, and of the few candidates by
        descriptors none may be the place. Drift that is small beside the view leaves it near.
        """
        _, ids = here.observations_of(keyframe)
        known = {k for _, k in here.covisible(ids)} | {keyframe.keyframe_id}
        near = [
            k
            for k in _alike(here, keyframe.camera_from_map, N_NEAR, known)
            if abs(k - keyframe.keyframe_id) >= OTHER_PASS
        ]
        for key in near[:N_CANDIDATES]:
            found = self._try(keyframe, here, here.keyframes[key], here, LOW_FOUND_RATIO)
            if found is not None and check(found, True):
                return found
        return None

    def find_placed(
        self, keyframe: Keyframe, here: SlamMap, maps: list[SlamMap], georeference_of: PlaceOf,
        check: LoopCheck,
    ) -> LoopClosure | None:  # fmt: skip
        """A confirmed loop closure with another map that lies about there in the world, or None.

        In faint pictures a tenth of the points is found again, as on another day: of a place that
        other measurements tell, it is enough that chance finds a third of that.
        """
        placed = georeference_of(here)
        for there in maps:
            other = georeference_of(there)
            if not (placed and placed.has_origin and other and other.has_origin):
                continue
            there_from_here = other.world_from_map.inverse() @ placed.world_from_map
            expected = camera_from_there(keyframe.camera_from_map, there_from_here.inverse())
            for key in self._in_view(there, expected):
                found = self._try(keyframe, here, there.keyframes[key], there, None)
                if found is not None and check(found, False):
                    return found
        return None

    def _in_view(self, there: SlamMap, camera_from_map: Pose) -> list[int]:
        """Keyframes nearest to a camera that look alike and show what is in its view."""
        return [
            key
            for key in _alike(there, camera_from_map, N_CANDIDATES, set())
            if self._relocalizer.n_in_view(there, there.keyframes[key], camera_from_map) > MIN_FOUND
        ]

    def _candidates(
        self, keyframe: Keyframe, near: set[int], here: SlamMap, maps: list[SlamMap]
    ) -> list[int]:
        """Similar keyframes, and of other maps as many: those of its own are more alike."""
        descriptors = keyframe.features.descriptors
        found = self._database.query(descriptors, N_CANDIDATES, near)
        if all(each is here for each in maps):
            return found
        others = self._database.query(descriptors, N_CANDIDATES, near | here.keyframes.keys())
        return list(dict.fromkeys([*found, *others]))

    def _try(
        self, keyframe: Keyframe, here: SlamMap, other: Keyframe, there: SlamMap,
        share: float | None = MIN_FOUND_RATIO,
    ) -> LoopClosure | None:  # fmt: skip
        level = keyframe.camera_from_map.rotation.T if here.level and there.level else None
        relocalised = self._relocalizer.relocalise(
            keyframe.features,
            there,
            other,
            level,
            keyframe.keyframe_id,
            None if share is None else MIN_FOUND_RATIO,
        )
        if relocalised is None:
            return None
        here_from_there = estimate_similarity(keyframe, here, relocalised, there)
        if here_from_there is None:
            return None
        if level is not None and _tilt(here_from_there.rotation) > MAX_TILT_RAD:
            return None
        if here is there and not 1 / MAX_SCALE_DRIFT < here_from_there.scale < MAX_SCALE_DRIFT:
            return None
        confirming = self._n_confirming(keyframe, here, other, there, here_from_there, share)
        if confirming < MIN_CONFIRMING:
            return None
        return LoopClosure(keyframe, there, relocalised, here_from_there)

    def _n_confirming(
        self,
        keyframe: Keyframe,
        here: SlamMap,
        other: Keyframe,
        there: SlamMap,
        here_from_there: Similarity,
        share: float | None,
    ) -> int:
        """Number of covisible neighbours verified in the other part, by that share of points."""
        _, ids = here.observations_of(keyframe)
        ranked = [here.keyframes[k] for _, k in here.covisible(ids)]
        neighbours = [k for k in ranked if k is not keyframe][:N_NEIGHBOURS]
        return sum(
            self._relocalizer.verify(
                k.features,
                there,
                other,
                camera_from_there(k.camera_from_map, here_from_there),
                share,
            )
            is not None
            for k in neighbours
        )


def _alike(slam_map: SlamMap, camera_from_map: Pose, n: int, exclude: set[int]) -> list[int]:
    """Of the `n` keyframes nearest to a camera, without those excluded, those that look alike."""
    axis, centre = camera_from_map.rotation[2], camera_from_map.inverse().translation
    return [
        key
        for key in slam_map.nearest(centre, n, exclude)
        if slam_map.keyframes[key].camera_from_map.rotation[2] @ axis > SAME_VIEW
    ]


def camera_from_there(camera_from_here: Pose, here_from_there: Similarity) -> Pose:
    """Pose of a camera in the other map, in its units."""
    s = here_from_there
    return Pose(
        camera_from_here.rotation @ s.rotation, camera_from_here.apply(s.translation) / s.scale
    )


def estimate_similarity(
    keyframe: Keyframe, here: SlamMap, relocalised: Relocalised, there: SlamMap
) -> Similarity | None:
    """`here_from_there` of a camera in both maps; scale by the depths of shared points."""
    own = keyframe.point_ids[relocalised.features]
    both = (own >= 0) & here.alive[np.maximum(own, 0)]
    if both.sum() < MIN_SHARED:
        return None
    depth_here = keyframe.camera_from_map.apply(here.positions[own[both]])[:, 2]
    depth_there = relocalised.camera_from_map.apply(there.positions[relocalised.points[both]])[:, 2]
    ratio = depth_here / depth_there
    scale = float(np.median(ratio))
    spread = 1.4826 * float(np.median(np.abs(ratio / scale - 1.0)))
    if scale <= 0 or spread > MAX_SCALE_SPREAD:
        return None
    here_from_camera = keyframe.camera_from_map.inverse()
    camera = Similarity(
        scale, relocalised.camera_from_map.rotation, scale * relocalised.camera_from_map.translation
    )
    return Similarity(1.0, here_from_camera.rotation, here_from_camera.translation) @ camera


def _tilt(rotation: Array) -> float:
    """Change of the vertical by a rotation, rad."""
    upright = np.arctan2(rotation[1, 0] - rotation[0, 1], rotation[0, 0] + rotation[1, 1])
    c, s = np.cos(upright), np.sin(upright)
    return angle_between(rotation, np.array([[c, -s, 0.0], [s, c, 0.0], [0, 0, 1.0]]))
