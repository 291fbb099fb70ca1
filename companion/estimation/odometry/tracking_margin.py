"""The margin of tracking: it is said while there are still poses that it comes near its limits.

Ground that passes too fast for the rate of the camera, too little contrast, too few points in view.
"""

from __future__ import annotations

from collections import Counter, deque

import numpy as np

from companion.geometry.camera import Camera
from companion.geometry.transforms import Array
from companion.messages import Track, TrackState, Warned
from companion.slam.features.view import View
from companion.slam.map.sparse_map import SlamMap

MAX_PASSED_RATIO = 0.25
"""Of the last frame's points, those that have gone one frame later. A point takes two frames to be
measured and a third to be of use; at this ratio it is seen in four."""
BORDER_PX = 31
"""No feature is seen nearer to the edge of the picture (the border of cv2.ORB)."""
FEW_MATCHES, FEW_OF_FAINT = 100, 150
"""Points matched in a frame, and where few features are seen: with 150 a pose is as good as it
gets, with 50, over drawn ground, its scale drifts by 1 % a second. Faint ground is told the sooner,
as its points go all at once."""
MIN_FEATURE_RATIO = 0.75
"""Features, of those asked for: fewer are seen where the lowest threshold finds no more, and then
many of them are noise."""
WINDOW_NS, LEAST_FRAMES = 600_000_000, 4
CLEAR_NS = 3_000_000_000
"""Without such frames, until the limits are said to be away: a vehicle that weaves comes back."""

TOO_FAST = "the ground passes too fast for the camera: tracking may fail"
TOO_FAINT = "too little contrast: tracking may fail"
TOO_FEW = "few points in view: tracking may fail"
AWAY = "tracking is away from its limits again"


class TrackingMargin:
    """Frames in, warnings out: where more than half of the latest frames are near a limit."""

    def __init__(self, camera: Camera, n_features: int) -> None:
        self._camera = camera
        self._n_features = n_features
        self._recent: deque[tuple[int, str]] = deque()
        """Times, and what they are near, "" if nothing."""
        self._last: tuple[int, SlamMap, Array] | None = None
        """The last tracked frame: its number, its map, and the points (N, 3) that it saw."""
        self.is_near = False
        """True if the newest frame was near a limit."""
        self._said: set[str] = set()
        self._near_ns = 0

    def take(
        self, track: Track, view: View | None, slam_map: SlamMap, n_seen: int, ratio: float,
        drowned: bool = False,
    ) -> list[Warned]:  # fmt: skip
        """Add a frame: its track, its view where it is tracked, and the features seen in it.

        `ratio` is that of the features asked for that load leaves. In a picture that is `drowned`
        features are many and matched, until they are lost all at once.
        """
        t_ns, limit = track.t_ns, self._limit(track, view, slam_map, n_seen, ratio)
        if drowned:
            limit = TOO_FAINT
        self.is_near = bool(limit)
        if limit is not None:
            self._recent.append((t_ns, limit))
        while self._recent and t_ns - self._recent[0][0] > WINDOW_NS:
            self._recent.popleft()
        n_by_kind = Counter(kind for _, kind in self._recent if kind)
        if len(self._recent) >= LEAST_FRAMES and 2 * n_by_kind.total() > len(self._recent):
            self._near_ns = t_ns
            kind = n_by_kind.most_common(1)[0][0]
            if kind in self._said:
                return []
            self._said.add(kind)
            seen = f"{n_seen} features, {track.n_matches} points matched"
            return [Warned(t_ns, kind, seen)]
        if self._said and t_ns - self._near_ns > CLEAR_NS and track.state is TrackState.TRACKING:
            self._said.clear()
            return [Warned(t_ns, AWAY, good=True)]
        return []

    def _limit(
        self, track: Track, view: View | None, slam_map: SlamMap, n_seen: int, ratio: float
    ) -> str | None:
        """The limit that a frame is near, "" if none; None where it cannot be told."""
        faint = n_seen < MIN_FEATURE_RATIO * ratio * self._n_features
        if view is None:
            self._last = None
            return TOO_FAINT if faint else None
        passed = self._passed(view, slam_map)
        self._last = view.seq, slam_map, slam_map.positions[view.point_ids[view.point_ids >= 0]]
        if passed > MAX_PASSED_RATIO:
            return TOO_FAST
        n_matched = min(track.n_inliers, track.n_matches)
        if faint and n_matched < FEW_OF_FAINT * ratio:
            return TOO_FAINT
        return TOO_FEW if n_matched < FEW_MATCHES * ratio else ""

    def _passed(self, view: View, slam_map: SlamMap) -> float:
        """Ratio of the last tracked frame's points that are out of the picture; 0 if unknown."""
        if self._last is None or self._last[1] is not slam_map or not len(self._last[2]):
            return 0.0
        now_px = self._camera.project(view.camera_from_map.apply(self._last[2]))
        size_px = np.array([self._camera.width, self._camera.height])
        seen = (now_px > BORDER_PX) & (now_px < size_px - BORDER_PX)
        return float(np.mean(~seen.all(1)))
