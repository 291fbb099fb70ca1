"""Observation kernel: the living points that a keyframe observes."""

from __future__ import annotations

import numpy as np

from companion.slam.compiled.compiling import Bools, Ints, compiled, flags, integers


@compiled(integers, flags)
def observed(point_ids: Ints, alive: Bools) -> tuple[Ints, Ints]:
    """Features and living points (same length) of a keyframe; -1 is no point."""
    n, features = 0, np.empty(len(point_ids), np.int64)
    for i in range(len(point_ids)):
        if point_ids[i] >= 0 and alive[point_ids[i]]:
            features[n] = i
            n += 1
    features = features[:n].copy()
    return features, point_ids[features]
