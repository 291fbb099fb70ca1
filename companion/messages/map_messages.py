"""Messages about the map: its keyframes, loops and georeference, and the maps of other flights."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from companion.geometry.transforms import Array, Pose, Similarity
from companion.messages.frame_messages import Bytes


@dataclass(frozen=True, slots=True)
class SiteMapUsed:
    """The map of an earlier flight that this one uses: its file, revision and BLAKE2b digest."""

    t_ns: int
    path: str
    revision: int
    digest: str


@dataclass(frozen=True, slots=True, eq=False)
class MapTakenUp:
    """The map of a process before, looked for from the frame at `t_ns` on.

    `data` (N,) are the bytes of its checkpoint, whose last frame was `absent_ns` ago.
    """

    t_ns: int
    absent_ns: int
    data: Bytes


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeAdded:
    """A new keyframe: its frame, and the map points that it sees.

    `points_camera` (N, 3) are these points in its camera frame, map units.
    """

    keyframe_id: int
    seq: int
    t_ns: int
    map_from_camera: Pose
    points_camera: Array


@dataclass(frozen=True, slots=True)
class LoopClosed:
    """A loop closure or map merge: keyframe `keyframe_id` observes what `other_id` did before.

    Within the same map a loop closed, which moved the newer end by `moved` map units; else two maps
    were merged, the other's unit being `scale` of this one's.
    """

    t_ns: int
    keyframe_id: int
    other_id: int
    same_map: bool
    moved: float
    scale: float


@dataclass(frozen=True, slots=True, eq=False)
class Georeference:
    """Transform of the map to the world: local NED in metres.

    `metres_per_unit` is `world_from_map.scale`; the sigmas are one standard deviation. `method` is
    the source of the scale in words.
    """

    world_from_map: Similarity
    sigma_scale: float
    """Standard deviation relative to the scale: 0.01 is one percent."""
    sigma_yaw_rad: float
    method: str
    n_positions: int
    residual_m: float
    has_origin: bool = True
    """False where only the scale is known: the world then begins at the first camera."""


@dataclass(frozen=True, slots=True, eq=False)
class Georeferenced:
    """Georeference of the newest map, without its keyframes and points."""

    t_ns: int
    georeference: Georeference | None


SPANS_REACH = 6
"""Number of keyframes before and after one whose distances give its local scale correction."""


@dataclass(frozen=True, slots=True, eq=False)
class MapUpdate:
    """The map now: every keyframe's pose, and the sparse points (N, 3) in map units.

    Of a map of more than a thousand keyframes the points are those near the newest one, but for the
    last update of a flight, which has all.

    `scale_of` holds, for keyframes of segments with a scale of their own, the number of map units
    in one unit of the keyframe's camera frame; all others are 1. A keyframe that is missing here
    has no known pose, and neither has what is attached to it. `n_retired` redundant keyframes have
    left the map and move with their neighbours.
    """

    revision: int
    t_ns: int
    map_from_camera: Mapping[int, Pose]
    points_map: Array
    georeference: Georeference | None
    scale_of: Mapping[int, float] = field(default_factory=dict)
    n_retired: int = 0

    @property
    def n_keyframes(self) -> int:
        """Keyframes in the map."""
        return len(self.map_from_camera) - self.n_retired

    def place_of(self, keyframe_id: int) -> Similarity | None:
        """Transform `map_from_camera` of a keyframe, scale included; None if unknown."""
        pose = self.map_from_camera.get(keyframe_id)
        if pose is None:
            return None
        return Similarity(self.scale_of.get(keyframe_id, 1.0), pose.rotation, pose.translation)

    def spans_of(self, keyframe_id: int) -> dict[int, float]:
        """Distances of neighbouring keyframes from one, in the unit of its camera frame."""
        place = self.place_of(keyframe_id)
        if place is None:
            return {}
        around = range(keyframe_id - SPANS_REACH, keyframe_id + SPANS_REACH + 1)
        others = [k for k in around if k != keyframe_id and self._with(place, k)]
        return {k: self._span(place, k) for k in others}

    def local_scale_of(self, keyframe_id: int, spans: Mapping[int, float]) -> float:
        """Local scale correction of measurements made about a keyframe when it had these spans.

        The median of the ratios of spans, weighted by length; 1 without any.
        """
        place = self.place_of(keyframe_id)
        if place is None:
            return 1.0
        ratios = sorted(
            (self._span(place, k) / span, span)
            for k, span in spans.items()
            if span > 0 and self._with(place, k)
        )
        half, passed = 0.5 * sum(span for _, span in ratios), 0.0
        for ratio, span in ratios:
            passed += span
            if passed >= half:
                return ratio
        return 1.0

    def _with(self, place: Similarity, other_id: int) -> bool:
        """True if a keyframe exists, and has the same scale."""
        unit = self.scale_of.get(other_id, 1.0)
        return other_id in self.map_from_camera and abs(unit / place.scale - 1.0) < 1e-9

    def _span(self, place: Similarity, other_id: int) -> float:
        away = self.map_from_camera[other_id].translation - place.translation
        return float(np.linalg.norm(away)) / place.scale
