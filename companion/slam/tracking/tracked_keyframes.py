"""Keyframes of what is tracked: the one that frames are told relative to, and new ones."""

from __future__ import annotations

import numpy as np

from companion.slam.features.view import View
from companion.slam.map.reports import keyframe_added
from companion.slam.map.sparse_map import Keyframe
from companion.slam.mapping.atlas import Atlas
from companion.slam.mapping.mapping_worker import Done, MappingWorker
from companion.slam.tracking.keyframe_choice import equivalent_keyframe, keyframe_of, needs_keyframe
from companion.timing.clock import Timer


class TrackedKeyframes:
    """Keyframes of the active map; `worker` maps the new ones."""

    def __init__(self, atlas: Atlas, worker: MappingWorker, times: Timer) -> None:
        self._atlas, self._worker, self._times = atlas, worker, times
        self.next_id = 0
        """The lowest id not used yet."""
        self.reset()

    def reset(self) -> None:
        """Another map has become active."""
        self.reference: Keyframe | None = None
        self._since_ns: int | None = None
        """Time since which the reference, an older keyframe, has been equivalent."""

    def needed(self, view: View) -> bool:
        """True if no keyframe makes a view redundant; an equivalent one becomes the reference."""
        slam_map, reference = self._atlas.map, self.reference
        if reference is not None and reference.keyframe_id not in slam_map.retired:
            since_ns = reference.t_ns if self._since_ns is None else self._since_ns
            if not needs_keyframe(slam_map, reference, view, since_ns):
                return False
        equivalent = equivalent_keyframe(slam_map, view)
        if equivalent is None:
            return True
        self.reference, self._since_ns = equivalent, view.t_ns
        return False

    def insert(self, view: View) -> Keyframe:
        """Make a tracked view a keyframe, the reference from now on, and have it mapped."""
        slam_map, keyframe = self._atlas.map, self.new(view)
        features = np.flatnonzero(view.point_ids >= 0)
        slam_map.add_observations(keyframe, features, view.point_ids[features])
        self.reference, self._since_ns = keyframe, None

        def extend() -> Done:
            with self._times("mapping"):
                loop_closed = self._atlas.insert_keyframe(slam_map, keyframe)
            added = keyframe_added(slam_map, keyframe)
            return [added] if loop_closed is None else [added, loop_closed]

        self._worker.submit(extend)
        # already adjusted, where it was done at once
        view.camera_from_map = keyframe.camera_from_map
        view.point_ids = keyframe.point_ids.copy()
        return keyframe

    def new(self, view: View) -> Keyframe:
        """A keyframe of a view, in no map yet."""
        keyframe = keyframe_of(view, self.next_id)
        self.next_id += 1
        return keyframe
