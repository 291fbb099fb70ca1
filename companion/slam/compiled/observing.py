"""Observation kernels: the living points that keyframes observe."""

from __future__ import annotations

import numpy as np

from companion.slam.compiled.compiling import Bools, Ints, compiled, flags, integers


@compiled(integers, flags)
def observed(point_ids: Ints, alive: Bools) -> tuple[Ints, Ints]:
    """Features and living points (same length) of a keyframe; -1 is no point."""
    n, features = 0, np.empty(len(point_ids), np.int64)
    if len(alive) == 0:
        return features[:0], features[:0].copy()
    for i in range(len(point_ids)):  # without a branch, which would be guessed wrong often
        features[n] = i
        n += (point_ids[i] >= 0) & alive[np.uintp(max(point_ids[i], 0))]
    features = features[:n].copy()
    return features, point_ids[features]


@compiled(integers, flags)
def distinct(ids: Ints, alive: Bools) -> Ints:
    """Living points among `ids` (N,), each once, ascending; -1 is no point."""
    lowest, highest = len(alive), -1
    for i in range(len(ids)):
        lowest = min(lowest, ids[i] if ids[i] >= 0 else len(alive))
        highest = max(highest, ids[i])
    if highest < 0:
        return np.zeros(0, np.int64)
    # on new ground their numbers lie together, in a map of any size
    seen = np.zeros(highest - lowest + 2, np.bool_)
    for i in range(len(ids)):
        point = ids[i]
        seen[np.uintp(point - lowest if point >= 0 else len(seen) - 1)] |= alive[
            np.uintp(max(point, 0))
        ]
    return np.flatnonzero(seen[:-1]) + lowest
