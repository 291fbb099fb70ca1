"""Poses of keyframes and the data attached to them, as the map moves. No clock, no I/O."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from companion.geometry.pose_table import PoseTable
from companion.geometry.transforms import Similarity
from companion.messages import SPANS_REACH, KeyframeAdded, MapUpdate, PointChunk
from companion.streaming.items import PlacesItem

MOVED_UNITS = 1e-4
"""Least movement, or relative change of scale, of a keyframe that is sent."""


class KeyframePlacement:
    """Follows a map, and gives the poses of moved keyframes.

    A keyframe's place has the local scale correction of the map since its points were measured, so
    that points sent once lie where they would be measured now.
    """

    def __init__(self) -> None:
        self.world: Similarity | None = None
        """Transform `world_from_map`; None while unknown."""
        self._update: MapUpdate | None = None
        self._mapped: dict[int, Similarity] = {}
        """Places in the newest map."""
        self._sent: dict[int, Similarity] = {}
        """Places with their local scale correction, as last sent."""
        self._spans: dict[int, Mapping[int, float]] = {}
        self._local_scale: dict[int, float] = {}

    def added(self, keyframe: KeyframeAdded) -> list[PlacesItem]:
        """Take a new keyframe, before the map has it."""
        pose = keyframe.map_from_camera
        keyframe_id = keyframe.keyframe_id
        self._mapped[keyframe_id] = Similarity(1.0, pose.rotation, pose.translation)
        return self._changes_of(keyframe.t_ns, {keyframe_id: self._mapped[keyframe_id]})

    def measured(self, chunk: PointChunk) -> list[PlacesItem]:
        """Take points, which may be of a map before the newest."""
        self._spans[chunk.keyframe_id] = chunk.spans
        if self._update is None or chunk.keyframe_id not in self._mapped:
            return []
        self._update_local_scale([chunk.keyframe_id], self._update)
        return self._changes_of(chunk.t_ns, {chunk.keyframe_id: self._mapped[chunk.keyframe_id]})

    def mapped(self, update: MapUpdate) -> list[PlacesItem]:
        """Take a new map. Only what differs from the one before is looked at."""
        poses, before = PoseTable.of(update.map_from_camera), self._update
        known = changed = set(poses.ids.tolist())
        if before is not None:
            changed = poses.changed_since(PoseTable.of(before.map_from_camera))
            changed |= {k for k, _ in update.scale_of.items() ^ before.scale_of.items()}
        self._update = update
        for keyframe_id in changed:
            place = update.place_of(keyframe_id)
            if place is not None:
                self._mapped[keyframe_id] = place
        last = max(known, default=-1)
        gone = {k for k in self._mapped if k < last and k not in known}
        for keyframe_id in gone:
            del self._mapped[keyframe_id]
        about = _about(changed | gone)
        self._update_local_scale(about, update)
        places = {k: self._mapped.get(k) for k in sorted(about) if k in known or k in gone}
        world = update.georeference.world_from_map if update.georeference is not None else None
        return self._changes_of(update.t_ns, places, world)

    def _update_local_scale(self, keyframe_ids: Iterable[int], update: MapUpdate) -> None:
        for keyframe_id in keyframe_ids:
            spans = self._spans.get(keyframe_id)
            if spans:
                self._local_scale[keyframe_id] = update.local_scale_of(keyframe_id, spans)

    def _changes_of(
        self, t_ns: int, places: Mapping[int, Similarity | None], world: Similarity | None = None
    ) -> list[PlacesItem]:
        """Places that have changed since they were last sent."""
        moved: dict[int, Similarity | None] = {}
        for keyframe_id, place in places.items():
            if place is None:
                if self._sent.pop(keyframe_id, None) is not None:
                    moved[keyframe_id] = None
                continue
            local_scale = self._local_scale.get(keyframe_id, 1.0)
            if local_scale != 1.0:
                place = replace(place, scale=local_scale * place.scale)
            if not _same(self._sent.get(keyframe_id), place, MOVED_UNITS):
                moved[keyframe_id] = self._sent[keyframe_id] = place
        if world is None or _same(self.world, world, MOVED_UNITS):
            world = None
        else:
            self.world = world
        return [PlacesItem(t_ns, moved, world)] if moved or world is not None else []


def _about(keyframe_ids: Iterable[int]) -> set[int]:
    """These keyframes and all whose spans may end at one of them."""
    reach = range(-SPANS_REACH, SPANS_REACH + 1)
    return {keyframe_id + k for keyframe_id in keyframe_ids for k in reach}


def _same(old: Similarity | None, new: Similarity, within: float) -> bool:
    if old is None or abs(new.scale / old.scale - 1.0) > within:
        return False
    moved = float(np.abs(old.translation - new.translation).max())
    turned = float(np.abs(old.rotation - new.rotation).max())
    return max(moved, turned) <= within
