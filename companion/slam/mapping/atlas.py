"""All maps of a flight: the one in use, those left behind, and how they come together again."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from companion.config import FeaturesConfig, MappingConfig
from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, angle_between
from companion.messages import LoopClosed
from companion.slam.features.orb_features import Features
from companion.slam.loop.loop_closure import Reunion, ReunionFinder
from companion.slam.loop.map_merge import close_loop, weld
from companion.slam.loop.place_recognition import PlaceIndex
from companion.slam.loop.relocalizer import MIN_SEEN_SHARE, Located, Relocalizer, around
from companion.slam.map.sparse_map import Keyframe, SlamMap
from companion.slam.mapping.map_adjustment import WaysOf, no_ways
from companion.slam.mapping.mapper import Mapper
from companion.slam.mapping.mapping_worker import MapTurn

MAX_YOUNG_KEYFRAMES = 5
"""A map that is lost again with so few keyframes was not worth keeping."""
N_LATEST, N_ALIKE = 3, 4
EXPECTED_SHARE = 0.1
"""Where a camera without attitude is expected, so much of what it should see is enough."""
REST = 8
"""Keyframes to wait after a reunion before the next is looked for."""
MAX_DRIFT_SHARE, MAX_DRIFT = 0.04, 0.3
"""A loop may be off by so much of the way flown since, and so many map units."""
SMALL_SHIFT, SMALL_TURN_RAD, SMALL_SCALE = 0.01, np.radians(0.2), 0.005
"""A loop that is off by less is closed by adjustment alone."""
LOOP_ITERATIONS = 5

Allowed = Callable[[Keyframe, Keyframe, Reunion], bool]


class Atlas:
    """Owns the maps. The last of `segments` is in use; keyframe ids are unique among all.

    With `beside` keyframes come while a reunion is worked in: the whole map is then adjusted when
    there is time, by `catch_up`.
    """

    def __init__(
        self, features: FeaturesConfig, mapping: MappingConfig, camera: Camera, turn: MapTurn,
        beside: bool = False,
    ) -> None:  # fmt: skip
        self._beside = beside
        self._features, self._mapping = features, mapping
        self._camera, self._turn = camera, turn
        self._relocalizer = Relocalizer(camera)
        self._places = PlaceIndex()
        self._finder = ReunionFinder(self._places, self._relocalizer)
        self._resting = 0
        self._due: SlamMap | None = None
        self.segments: list[SlamMap] = []
        self.allowed: Allowed = lambda keyframe, other, reunion: True
        """What is known beside the images has a say in whether a reunion is believed."""
        self.ways_of: WaysOf = no_ways
        """How far cameras are apart by what is known beside the images."""
        self.n_loops = 0
        self.begin(level=False)

    @property
    def map(self) -> SlamMap:
        """The map in use."""
        return self.segments[-1]

    @property
    def mapper(self) -> Mapper:
        """Who extends the map in use."""
        return self.mapper_of(self.map)

    def mapper_of(self, segment: SlamMap) -> Mapper:
        """Who extends and adjusts a map."""
        return Mapper(self._mapping, self._camera, segment, self._turn, self.ways_of)

    def begin(self, level: bool) -> None:
        """Use a fresh map; one that was hardly begun is given up for it."""
        if self.segments and len(self.map.keyframes) <= MAX_YOUNG_KEYFRAMES:
            self.segments.pop()
        fresh = SlamMap(self._features.scale_factor, self._features.n_levels, level=level)
        self.segments.append(fresh)

    def take_up(self, kept: SlamMap) -> None:
        """Use a map from before, and know its places again; no other may have begun."""
        self.segments = [kept]
        for keyframe in kept.keyframes.values():
            self.remember(keyframe)

    def leave(self, first_keyframe_id: int) -> bool:
        """Let go of a map by its name; whether it was in use, and a fresh one now is."""
        in_use = self.map.first_keyframe_id == first_keyframe_id
        self.segments = [s for s in self.segments if s.first_keyframe_id != first_keyframe_id]
        if in_use:
            self.begin(level=False)
        return in_use

    def give_up(self, keep: bool) -> None:
        """Use a fresh map in place of one that is wrong now, and all of it unless `keep`."""
        if keep:
            self.begin(level=False)
            return
        gone = self.segments.pop()
        for key in gone.keyframes:
            if key in self._places:
                self._places.remove(key)
        self.begin(level=False)

    def find(
        self, features: Features, level_from_camera: Array | None, seed: int
    ) -> tuple[SlamMap, Located] | None:
        """Where a camera is that knows nothing: by the latest keyframes, then by any alike."""
        latest = list(self.map.keyframes)[: -N_LATEST - 1 : -1]
        alike = self._places.alike(features.descriptors, N_ALIKE, set(latest))
        for key in [*latest, *alike]:
            segment = next((s for s in self.segments if key in s.keyframes), None)
            if segment is None:
                continue
            level = level_from_camera if segment.level else None
            expected = level_from_camera is None and key in latest
            found = self._relocalizer.locate(
                features, segment, segment.keyframes[key], level, seed,
                EXPECTED_SHARE if expected else MIN_SEEN_SHARE,
            )  # fmt: skip
            if found is not None:
                return segment, found
        return None

    def locate_by(
        self, features: Features, keyframe: Keyframe, level_from_camera: Array | None, seed: int
    ) -> Located | None:
        """Where a camera is that most likely sees what a keyframe of the map in use saw."""
        level = level_from_camera if self.map.level else None
        share = MIN_SEEN_SHARE if level_from_camera is not None else EXPECTED_SHARE
        return self._relocalizer.locate(features, self.map, keyframe, level, seed, share)

    def use(self, segment: SlamMap) -> None:
        """Use a map that was left behind."""
        if len(self.map.keyframes) <= MAX_YOUNG_KEYFRAMES:
            self.segments.pop()
        self.segments.remove(segment)
        self.segments.append(segment)

    def extend(self, segment: SlamMap, keyframe: Keyframe) -> LoopClosed | None:
        """Take a keyframe into a map, and whatever it shows to be the same place."""
        mapper = self.mapper_of(segment)
        for gone in mapper.add(keyframe):
            self._places.remove(gone)
        self._turn.give_way()
        self._resting -= 1
        found = None
        if self._resting <= 0 and len(segment.keyframes) > MAX_YOUNG_KEYFRAMES:
            found = self._finder.find(
                keyframe, segment, self.segments, self._believed, self._turn.give_way
            )
        self._places.add(keyframe.keyframe_id, keyframe.features.descriptors)
        if found is None or segment is not self.map:  # meanwhile another may have come into use
            return None
        self._resting = REST
        return self._unite(segment, mapper, found)

    def remember(self, keyframe: Keyframe) -> None:
        """Know a keyframe again that was put into a map by other means than `extend`."""
        self._places.add(keyframe.keyframe_id, keyframe.features.descriptors)

    def _unite(self, segment: SlamMap, mapper: Mapper, found: Reunion) -> LoopClosed:
        same = found.there is segment
        moved, keyframe, other = 0.0, found.keyframe, found.located.keyframe
        seen_there = around(found.there, other)
        tie = found.here_from_there
        if not same:
            offset = segment.n_points
            weld(segment, found.there, tie)
            self.segments = [s for s in self.segments if s is not found.there]
            seen_there = seen_there + offset
        elif _large(found):
            moved = close_loop(segment, found)
        self.n_loops += 1
        mapper.unite(keyframe, other, seen_there)
        if self._beside:
            mapper.adjust_locally(other)
            self._due = segment if not same or moved else self._due
        elif not same or moved:
            mapper.adjust_all(LOOP_ITERATIONS)
        return LoopClosed(
            keyframe.t_ns, keyframe.keyframe_id, other.keyframe_id, same, moved, tie.scale
        )

    def catch_up(self, meanwhile: Callable[[], None]) -> None:
        """Adjust all of a map in which a loop was closed, while it goes on; see `Spare`."""
        while self._due is not None:
            segment, self._due = self._due, None
            n_loops = self.n_loops

            def still(segment: SlamMap = segment, n_loops: int = n_loops) -> bool:
                return self.n_loops == n_loops and segment in self.segments

            self.mapper_of(segment).adjust_all_later(LOOP_ITERATIONS, meanwhile, still)

    def _believed(self, found: Reunion, same: bool) -> bool:
        if same and not _drift_explains(found):
            return False
        return self.allowed(found.keyframe, found.located.keyframe, found)


def _large(found: Reunion) -> bool:
    tie, centre = found.here_from_there, found.located.keyframe.centre
    return (
        float(np.linalg.norm(tie.apply(centre) - centre)) > SMALL_SHIFT
        or angle_between(tie.rotation, np.eye(3)) > float(SMALL_TURN_RAD)
        or abs(np.log(tie.scale)) > SMALL_SCALE
    )


def _drift_explains(found: Reunion) -> bool:
    """Whether the map can have gone astray so far on the way from the one place to the other."""
    first, last = sorted((found.keyframe.keyframe_id, found.located.keyframe.keyframe_id))
    centres = np.stack(
        [k.centre for key, k in found.there.keyframes.items() if first <= key <= last]
    )
    way = float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())
    here = found.keyframe.centre
    off = float(np.linalg.norm(found.here_from_there.inverse().apply(here) - here))
    return off < MAX_DRIFT + MAX_DRIFT_SHARE * way
