"""The atlas: all maps of a flight, the active one last, and their loops and merges."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from companion.config import FeaturesConfig
from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Similarity, angle_between
from companion.messages import LoopClosed
from companion.slam.features.orb_features import Features
from companion.slam.loop.loop_closure import LoopClosure, LoopDetector, PlaceOf
from companion.slam.loop.map_merge import close_loop, loop_graph, merge_maps
from companion.slam.loop.place_recognition import KeyframeDatabase, PlaceBlock, place_blocks
from companion.slam.loop.relocalizer import (
    MIN_FOUND_RATIO,
    Relocalised,
    Relocalizer,
    covisible_points,
)
from companion.slam.map.sparse_map import Keyframe, SlamMap
from companion.slam.mapping.far_keyframes import ArrayFile, leave_behind
from companion.slam.mapping.map_adjustment import DisplacementSource, no_displacements
from companion.slam.mapping.mapper import Mapper
from companion.slam.mapping.mapping_worker import MapLock

MAX_DISCARDED_KEYFRAMES = 5
"""A map lost again with at most this many keyframes is discarded."""
N_LATEST, N_CANDIDATES = 3, 4
EXPECTED_FOUND_RATIO = 0.1
"""Found ratio that suffices near the latest keyframes where no attitude is measured."""
LOOP_COOLDOWN = 8
"""Keyframes after a loop closure before the next search."""
NEAR_LOOP_EVERY = 4
"""Keyframes from one search nearby to the next, at the end: neighbours see the same."""
MAX_DRIFT_RATIO, MAX_DRIFT = 0.04, 0.3
"""Largest loop error relative to the path flown since, and in map units."""
MIN_LOOP_SHIFT, MIN_LOOP_ROTATION_RAD, MIN_LOOP_LOG_SCALE = 0.01, np.radians(0.2), 0.005
"""Below these corrections a loop is closed by bundle adjustment alone, without a pose graph."""
LOOP_ITERATIONS = 5

LoopCheck = Callable[[Keyframe, Keyframe, LoopClosure], bool]
MIN_KEYFRAMES_LOCATED = 3
"""Keyframes of a map that is looked for in that of an earlier flight: neighbours confirm it."""


class Atlas:
    """Owns the maps. The last of `segments` is active; keyframe ids are unique among all.

    With `background` mapping keyframes arrive while a loop is being closed: the global adjustment
    then runs in idle time, by `adjust_pending`.
    """

    def __init__(
        self, features: FeaturesConfig, camera: Camera, map_lock: MapLock, background: bool = False
    ) -> None:
        self._background = background
        self._features, self._camera, self._map_lock = features, camera, map_lock
        self._relocalizer = Relocalizer(camera)
        self.free_index()
        self._cooldown = 0
        self._pending: SlamMap | None = None
        """Map that is to be adjusted in idle time."""
        self._bent: set[int] = set()
        """Keyframes that loops have moved against others since it was."""
        self.site: SlamMap | None = None
        """Map of an earlier flight, until the active one is found in it."""
        self._site_finder = LoopDetector(KeyframeDatabase(), self._relocalizer)
        self._site_places: Sequence[PlaceBlock] = ()
        self.on_merge: Callable[[SlamMap, SlamMap, Similarity], None] = lambda here, there, by: None
        """Called when `here` takes over `there`; `by` is here_from_there."""
        self.segments: list[SlamMap] = []
        self.loop_allowed: LoopCheck = lambda keyframe, other, loop: True
        """Accepts or rejects a loop closure by information other than the images."""
        self.displacements_of: DisplacementSource = no_displacements
        """Displacement factors between cameras, from information other than the images."""
        self.georeference_of: PlaceOf = lambda segment: None
        """Place of a map in the world, by other measurements; None where it is unknown."""
        self.far_file: ArrayFile | None = None
        """Takes most of the keyframes that are left behind; without one they stay in memory."""
        self.n_loops = 0
        self.new_map(level=False)

    @property
    def map(self) -> SlamMap:
        """The active map."""
        return self.segments[-1]

    @property
    def mapper(self) -> Mapper:
        """Mapper of the active map."""
        return self.mapper_of(self.map)

    def mapper_of(self, segment: SlamMap) -> Mapper:
        """Mapper of a map."""
        forget = self.far_file.forget if self.far_file is not None else lambda: None
        return Mapper(self._camera, segment, self._map_lock, self.displacements_of, forget)

    def new_map(self, level: bool) -> None:
        """Activate a new map; an active one that is too young is discarded."""
        if self.segments and len(self.map.keyframes) <= MAX_DISCARDED_KEYFRAMES:
            self.segments.pop()
        fresh = SlamMap(self._features.scale_factor, self._features.n_levels, level=level)
        self.segments.append(fresh)

    def free_index(self) -> None:
        """Begin the index of places anew, or free it where no keyframe comes any more."""
        self._database = KeyframeDatabase()
        self._finder = LoopDetector(self._database, self._relocalizer)

    def resume(self, kept: SlamMap) -> None:
        """Activate a stored map and index its keyframes; no other may have been initialised.

        It is looked for in the map of an earlier flight unless ids of both could be confused, as
        where it holds keyframes of that flight already.
        """
        if self.site is not None and not self.site.keyframes.keys().isdisjoint(kept.keyframes):
            self.site = None
        self.segments = [kept]
        for keyframe in kept.keyframes.values():
            self.index_keyframe(keyframe)

    def use_site(self, site: SlamMap, places: Sequence[PlaceBlock] = ()) -> None:
        """Look for the active map in that of an earlier flight, until it is found there.

        `places` indexes its keyframes; without, they are all read.
        """
        self._site_places = places or list(
            place_blocks((key, k.features.descriptors) for key, k in site.keyframes.items())
        )
        database = KeyframeDatabase()
        database.add_blocks(self._site_places)
        self.site, self._site_finder = site, LoopDetector(database, self._relocalizer)

    def drop_map(self, first_keyframe_id: int) -> bool:
        """Remove a map by its first keyframe; whether it was active, and a new one is now."""
        in_use = self.map.first_keyframe_id == first_keyframe_id
        self.segments = [s for s in self.segments if s.first_keyframe_id != first_keyframe_id]
        if in_use:
            self.new_map(level=False)
        return in_use

    def discard_map(self, keep: bool) -> None:
        """Replace the active map, found wrong, by a new one; keep it as a segment with `keep`."""
        if keep:
            self.new_map(level=False)
            return
        discarded = self.segments.pop()
        for key in discarded.keyframes:
            if key in self._database:
                self._database.remove(key)
        self.new_map(level=False)

    def relocalise(
        self, features: Features, level_from_camera: Array | None, seed: int
    ) -> tuple[SlamMap, Relocalised] | None:
        """Relocalise a camera: against the latest keyframes, then by place recognition."""
        latest = list(self.map.keyframes)[: -N_LATEST - 1 : -1]
        similar = self._database.query(features.descriptors, N_CANDIDATES, set(latest))
        for key in [*latest, *similar]:
            segment = next((s for s in self.segments if key in s.keyframes), None)
            if segment is None:
                continue
            level = level_from_camera if segment.level else None
            expected = level_from_camera is None and key in latest
            found = self._relocalizer.relocalise(
                features, segment, segment.keyframes[key], level, seed,
                EXPECTED_FOUND_RATIO if expected else MIN_FOUND_RATIO,
            )  # fmt: skip
            if found is not None:
                return segment, found
        return None

    def relocalise_by(
        self, features: Features, keyframe: Keyframe, level_from_camera: Array | None, seed: int
    ) -> Relocalised | None:
        """Relocalise a camera against one keyframe of the active map."""
        level = level_from_camera if self.map.level else None
        share = MIN_FOUND_RATIO if level_from_camera is not None else EXPECTED_FOUND_RATIO
        return self._relocalizer.relocalise(features, self.map, keyframe, level, seed, share)

    def switch_to(self, segment: SlamMap) -> None:
        """Activate another segment."""
        if len(self.map.keyframes) <= MAX_DISCARDED_KEYFRAMES:
            self.segments.pop()
        self.segments.remove(segment)
        self.segments.append(segment)

    def insert_keyframe(self, segment: SlamMap, keyframe: Keyframe) -> LoopClosed | None:
        """Map a keyframe, then search for a loop with it and close that."""
        mapper = self.mapper_of(segment)
        for culled in mapper.add(keyframe):
            self._database.remove(culled)
        leave_behind(segment, self.far_file, self._map_lock)
        self._map_lock.yield_to_tracking()
        self._cooldown -= 1
        found = None
        if self._cooldown <= 0 and len(segment.keyframes) > MAX_DISCARDED_KEYFRAMES:
            found = self._finder.find(
                keyframe, segment, self.segments, self._plausible, self._map_lock.yield_to_tracking
            )
        if found is None and self.site and len(segment.keyframes) >= MIN_KEYFRAMES_LOCATED:
            found = self._site_finder.find(
                keyframe, segment, [self.site], self._plausible, self._map_lock.yield_to_tracking
            )
        self._database.add(keyframe.keyframe_id, keyframe.features.descriptors)
        if found is None or segment is not self.map:  # another map may be active by now
            return None
        self._cooldown = LOOP_COOLDOWN
        return self._close(segment, mapper, found)

    def join_maps(self) -> list[LoopClosed]:
        """Join maps that show the same place, at the end of a flight.

        In flight only the active map is looked for in the others, as they were then.
        """
        joined = []
        waiting = sorted(self.segments, key=lambda each: len(each.keyframes))[:-1]
        while waiting:
            segment = waiting.pop(0)
            others = [each for each in self.segments if each is not segment]
            if len(others) == len(self.segments):
                continue  # joined by now
            for keyframe in list(segment.keyframes.values()):
                found = self._finder.find(
                    keyframe, segment, others, self._plausible
                ) or self._finder.find_placed(
                    keyframe, segment, others, self.georeference_of, self._plausible
                )
                closed = found and self._close(segment, self.mapper_of(segment), found)
                if closed:
                    joined.append(closed)
                    waiting.append(segment)  # with what it took over it may meet another
                    break
        return joined

    def close_near_loops(self) -> list[LoopClosed]:
        """Close loops between passes near each other in the active map, at the end of a flight.

        Without attitude alone: where gravity is measured little drift is left.
        """
        segment, closed = self.map, []
        if segment.level or segment.held:
            return []
        for key in list(segment.keyframes)[::-NEAR_LOOP_EVERY]:
            keyframe = segment.keyframes.get(key)
            found = keyframe and self._finder.find_near(keyframe, segment, self._plausible)
            loop = found and self._close(segment, self.mapper, found)
            if loop:
                closed.append(loop)
        return closed

    def index_keyframe(self, keyframe: Keyframe) -> None:
        """Add a keyframe to place recognition that was not added by `insert_keyframe`."""
        self._database.add(keyframe.keyframe_id, keyframe.features.descriptors)

    def _close(self, segment: SlamMap, mapper: Mapper, found: LoopClosure) -> LoopClosed | None:
        """Close a loop; None where frames have begun another map meanwhile."""
        same = found.there is segment
        moved, keyframe, other = 0.0, found.keyframe, found.relocalised.keyframe
        seen_there = covisible_points(found.there, other)
        here_from_there = found.here_from_there
        if not same:
            offset = segment.n_points
            merge_maps(segment, found.there, here_from_there)
            self._bent.update(segment.keyframes)
            self.on_merge(segment, found.there, here_from_there)
            self.segments = [s for s in self.segments if s is not found.there]
            seen_there = seen_there + offset
        elif _needs_pose_graph(found):
            graph = loop_graph(segment, found, self._map_lock.yield_to_tracking)
            with self._map_lock.released():
                relaxed = graph.relaxed()
                bent = graph.bent(relaxed)
            if segment is not self.map:
                return None
            moved = close_loop(segment, graph, relaxed)
            self._bent |= bent
        self.n_loops += 1
        mapper.close_loop(keyframe, other, seen_there)
        if found.there is self.site:
            self._take_over_site(segment, mapper)
        if self._background:
            mapper.adjust_locally(other)
            self._pending = segment if not same or moved else self._pending
        elif not same or moved:
            mapper.adjust_all(LOOP_ITERATIONS, self._bent)
            self._bent.clear()
        return LoopClosed(
            keyframe.t_ns,
            keyframe.keyframe_id,
            other.keyframe_id,
            same,
            moved,
            here_from_there.scale,
        )

    def _take_over_site(self, segment: SlamMap, mapper: Mapper) -> None:
        """Know the map of an earlier flight as part of the active one."""
        self.site = None
        self._database.add_blocks(self._site_places)
        for key, keyframe in list(segment.keyframes.items()):
            if key not in segment.held:
                self._map_lock.yield_to_tracking()
                mapper.fusion.fuse_held(keyframe)

    def adjust_pending(self, yield_point: Callable[[], None]) -> None:
        """Globally adjust maps with closed loops while they go on; an `IdleWork`."""
        while self._pending is not None:
            segment, self._pending = self._pending, None
            n_loops, bent = self.n_loops, self._bent.copy()

            def still_valid(segment: SlamMap = segment, n_loops: int = n_loops) -> bool:
                return self.n_loops == n_loops and segment in self.segments

            self.mapper_of(segment).adjust_all_in_background(
                LOOP_ITERATIONS, yield_point, still_valid, bent
            )
            if still_valid():
                self._bent -= bent

    def _plausible(self, found: LoopClosure, same: bool) -> bool:
        if same and not _within_drift(found):
            return False
        return self.loop_allowed(found.keyframe, found.relocalised.keyframe, found)


def _needs_pose_graph(found: LoopClosure) -> bool:
    here_from_there, centre = found.here_from_there, found.relocalised.keyframe.centre
    return (
        float(np.linalg.norm(here_from_there.apply(centre) - centre)) > MIN_LOOP_SHIFT
        or angle_between(here_from_there.rotation, np.eye(3)) > float(MIN_LOOP_ROTATION_RAD)
        or abs(np.log(here_from_there.scale)) > MIN_LOOP_LOG_SCALE
    )


def _within_drift(found: LoopClosure) -> bool:
    """True if drift along the path between the two keyframes explains the loop error."""
    first, last = sorted((found.keyframe.keyframe_id, found.relocalised.keyframe.keyframe_id))
    centres = found.there.centres(first, last)
    path_length = float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())
    here = found.keyframe.centre
    off = float(np.linalg.norm(found.here_from_there.inverse().apply(here) - here))
    return off < MAX_DRIFT + MAX_DRIFT_RATIO * path_length
