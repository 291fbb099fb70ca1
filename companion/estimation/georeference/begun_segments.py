"""Segments that began by inertial navigation: where, and how large that makes them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from companion.estimation.body.reckoned_path import BodyPlace
from companion.estimation.georeference.georeferencer import Georeferencer, place_new_map
from companion.estimation.georeference.segment_samples import SegmentSamples
from companion.messages import Georeference
from companion.slam.map.sparse_map import Keyframe, SlamMap


class BegunSegments:
    """Segments by their first keyframe."""

    def __init__(self, georeferencer: Georeferencer, samples: SegmentSamples) -> None:
        self._georeferencer, self._samples = georeferencer, samples
        self.reckoned_at: Callable[[int], BodyPlace | None] = lambda _t_ns: None
        """Place of the body by inertial navigation at a recent frame."""
        self._reckoned: dict[int, tuple[BodyPlace, Georeference | None]] = {}
        """Place at which a segment began by it, and the segment so placed."""

    def withdraw(self, since_ns: int) -> None:
        """Forget segments that began at a time or later."""
        late = [k for k, (start, _) in self._reckoned.items() if start.t_ns >= since_ns]
        for key in late:
            del self._reckoned[key]

    def of(self, segment: SlamMap, first: Keyframe) -> tuple[BodyPlace, Georeference | None] | None:
        """Place of the body by inertial navigation as a segment began, and the segment so placed.

        Found once, while the navigation does not go by this segment.
        """
        key = segment.first_keyframe_id
        if key not in self._reckoned:
            if first.keyframe_id != key:
                return None  # a later one that is left may have aided the navigation
            last = max(segment.keyframes.values(), key=lambda k: k.t_ns)
            start, end = self.reckoned_at(first.t_ns), self.reckoned_at(last.t_ns)
            if start is None or end is None or last is first:
                return None
            samples = self._samples.of(segment, [first, last])
            levers = self._georeferencer.levers_of(samples)
            moved_m = end.place_world_m + levers[1] - start.place_world_m - levers[0]
            sigma_m_s = float(np.sqrt(np.diag(end.start.covariance)[:3].max()))
            sigma_m = sigma_m_s * (last.t_ns - first.t_ns) * 1e-9
            from_m = start.place_world_m + levers[0]
            placed = place_new_map(samples, from_m, moved_m, sigma_m, "accelerometers")
            self._reckoned[key] = start, placed
        return self._reckoned[key]
