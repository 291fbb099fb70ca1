"""A place seen again: how two parts of the map, or two maps, lie to each other there.

A keyframe is put into the other part as a lost camera would be; its neighbours must then find there
what the answer predicts, which a repeating facade or a field of equal plants does not give them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from companion.geometry.transforms import Array, Pose, Similarity, angle_between
from companion.slam.loop.place_recognition import PlaceIndex
from companion.slam.loop.relocalizer import Located, Relocalizer
from companion.slam.map.sparse_map import Keyframe, SlamMap

N_CANDIDATES = 4
N_WITNESSES, MIN_WITNESSES = 3, 2
MIN_SHARED = 20
"""Features that show a point of both parts, from which the scale is taken."""
MAX_SCALE_SPREAD = 0.08
MAX_TILT_RAD = np.radians(10.0)
"""Each of two maps was levelled by an attitude that may be some degrees off, in its own heading."""
MAX_SCALE_DRIFT = 1.6
RECENT = 8
"""So many of the newest keyframes are no place seen again."""


@dataclass(frozen=True, slots=True, eq=False)
class Reunion:
    """A keyframe of one map in another, or in an older part of its own.

    `here_from_there` takes that part's coordinates to those of the keyframe's map.
    """

    keyframe: Keyframe
    there: SlamMap
    located: Located
    here_from_there: Similarity


Plausible = Callable[[Reunion, bool], bool]
"""Whether what else is known allows a reunion, and one within the same map if so said."""


class ReunionFinder:
    """Looks for reunions of new keyframes with all older ones."""

    def __init__(self, places: PlaceIndex, relocalizer: Relocalizer) -> None:
        self._places = places
        self._relocalizer = relocalizer

    def find(
        self, keyframe: Keyframe, here: SlamMap, maps: list[SlamMap], plausible: Plausible,
        between: Callable[[], None] = lambda: None,
    ) -> Reunion | None:  # fmt: skip
        """A reunion that is certain, or None. `between` is called before each keyframe tried."""
        _, ids = here.seen_by(keyframe)
        near = {k for _, k in here.covisible(ids, 8)} | set(sorted(here.keyframes)[-RECENT:])
        for key in self._places.alike(keyframe.features.descriptors, N_CANDIDATES, near):
            between()
            there = next((m for m in maps if key in m.keyframes), None)
            if there is None:
                continue
            found = self._try(keyframe, here, there.keyframes[key], there)
            if found is not None and plausible(found, here is there):
                return found
        return None

    def _try(
        self, keyframe: Keyframe, here: SlamMap, other: Keyframe, there: SlamMap
    ) -> Reunion | None:
        level = keyframe.camera_from_map.rotation.T if here.level and there.level else None
        located = self._relocalizer.locate(
            keyframe.features, there, other, level, keyframe.keyframe_id
        )
        if located is None:
            return None
        tie = tie_of(keyframe, here, located, there)
        if tie is None:
            return None
        if level is not None and _tilt(tie.rotation) > MAX_TILT_RAD:
            return None
        if here is there and not 1 / MAX_SCALE_DRIFT < tie.scale < MAX_SCALE_DRIFT:
            return None
        if self._witnesses(keyframe, here, other, there, tie) < MIN_WITNESSES:
            return None
        return Reunion(keyframe, there, located, tie)

    def _witnesses(
        self, keyframe: Keyframe, here: SlamMap, other: Keyframe, there: SlamMap, tie: Similarity
    ) -> int:
        """How many neighbours see in the other part what they should."""
        _, ids = here.seen_by(keyframe)
        ranked = [here.keyframes[k] for _, k in here.covisible(ids)]
        witnesses = [k for k in ranked if k is not keyframe][:N_WITNESSES]
        return sum(
            self._relocalizer.confirm(
                k.features, there, other, camera_from_there(k.camera_from_map, tie)
            )
            is not None
            for k in witnesses
        )


def camera_from_there(camera_from_here: Pose, here_from_there: Similarity) -> Pose:
    """A camera's pose in the other map, in that map's units."""
    s = here_from_there
    return Pose(
        camera_from_here.rotation @ s.rotation, camera_from_here.apply(s.translation) / s.scale
    )


def tie_of(
    keyframe: Keyframe, here: SlamMap, located: Located, there: SlamMap
) -> Similarity | None:
    """`here_from_there` by a camera that is in both; its scale from points that are too."""
    own = keyframe.point_ids[located.features]
    both = (own >= 0) & here.alive[np.maximum(own, 0)]
    if both.sum() < MIN_SHARED:
        return None
    depth_here = keyframe.camera_from_map.apply(here.positions[own[both]])[:, 2]
    depth_there = located.camera_from_map.apply(there.positions[located.points[both]])[:, 2]
    ratio = depth_here / depth_there
    scale = float(np.median(ratio))
    spread = 1.4826 * float(np.median(np.abs(ratio / scale - 1.0)))
    if scale <= 0 or spread > MAX_SCALE_SPREAD:
        return None
    here_from_camera = keyframe.camera_from_map.inverse()
    camera = Similarity(
        scale, located.camera_from_map.rotation, scale * located.camera_from_map.translation
    )
    return Similarity(1.0, here_from_camera.rotation, here_from_camera.translation) @ camera


def _tilt(rotation: Array) -> float:
    """How far a turn moves the vertical."""
    upright = np.arctan2(rotation[1, 0] - rotation[0, 1], rotation[0, 0] + rotation[1, 1])
    c, s = np.cos(upright), np.sin(upright)
    return angle_between(rotation, np.array([[c, -s, 0.0], [s, c, 0.0], [0, 0, 1.0]]))
