"""Keyframes that the newest have left behind: most of them, and patches of their points, in a file.

Poses, and which points a keyframe observes, stay in memory. What is in the file is read where it
lies, so that no result depends on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from typing import Any, Protocol

import numpy as np

from companion.slam.features.orb_features import Features
from companion.slam.map.patch_store import NO_PATCH
from companion.slam.map.seen import Seen, SeenLater
from companion.slam.map.sparse_map import SlamMap
from companion.slam.mapping.mapping_worker import MapLock

N_NEAR = 400
"""Newest keyframes, all in memory: two minutes of new ground where every third picture is one, and
0.2 MB each at 1200 features."""
MOST_AT_ONCE = 2
"""More than come, so that a map which was joined is put away, too."""
OF_FEATURES = (
    "pixels", "normalised", "octaves", "angles_deg", "descriptors", "sigma_px", "whitening",
)  # fmt: skip


class ArrayFile(Protocol):
    """Keeps arrays that are seldom read, and never written to."""

    def put(self, arrays: Sequence[Any]) -> list[Any] | None:
        """Equal arrays, which are read from the file as they are used; None where it is full."""

    def forget(self) -> None:
        """Give back the memory of what was read."""


def put_away(seen: Seen, file: ArrayFile) -> Seen:
    """A copy in a file, if that takes it, of what a keyframe saw that nothing changes any more."""
    kept = file.put(_arrays_of(seen))
    return seen if kept is None else _seen_of(kept)


def _arrays_of(seen: Seen | SeenLater) -> list[Any]:
    features = (getattr(seen.features, name) for name in OF_FEATURES)
    return [*features, seen.normalised, seen.whitening]


def _seen_of(kept: Sequence[Any]) -> Seen:
    *of_features, normalised, whitening = kept
    return Seen(Features(*of_features), normalised, whitening)


def leave_behind(slam_map: SlamMap, file: ArrayFile | None, map_lock: MapLock) -> None:
    """Put away what is left behind, the newest first, with the lock held but for the writing."""
    for key in list(islice(reversed(slam_map.keyframes), N_NEAR, N_NEAR + MOST_AT_ONCE)):
        keyframe = slam_map.keyframes[key]
        if keyframe.is_far:
            return
        slam_map.leave_behind(keyframe)
        _, points = slam_map.observations_of(keyframe)
        points = np.unique(points[slam_map.patch_at[points] > NO_PATCH])
        patches = slam_map.patches_of(points).grey
        arrays = [*_arrays_of(keyframe.seen), keyframe.refined_for, patches]
        with map_lock.released():  # only mapping changes old keyframes and patches of their points
            kept = None if file is None else file.put(arrays)
        if kept is None:
            continue
        *of_seen, keyframe.refined_for, patches = kept
        keyframe.seen = _seen_of(of_seen)
        slam_map.put_patches_away(points, patches)
