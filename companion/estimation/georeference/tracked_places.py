"""Places of tracked frames, which move with the keyframes that they were tracked by."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.geometry.pose_table import PoseTable
from companion.geometry.transforms import Array, Pose, nearest_rotation

SPACING_NS = 45_000_000
"""Frames closer than this see the same features, with the same errors."""
HOVER_NS = 10_000_000_000
"""Frames by one keyframe for longer are of a hover. They tell no scale: what a map's places err by
is not white there, and 90 s of it in a firmware's simulator told a scale 16 % too small, to 3 %."""
PAUSE_NS = 1_000_000_000
MAX_PLACES = 8192
"""Six minutes at 20 a second, 2 MB; the older half goes when they are full."""


class Places(NamedTuple):
    """Frames in order of time: t_ns (N,), and of each its pose in the map and its attitude.

    `rotations` (N, 3, 3) and `places` (N, 3) are `map_from_camera`, map units; `ned_from_camera`
    (N, 3, 3) is by the autopilot.
    """

    t_ns: NDArray[np.int64]
    rotations: Array
    places: Array
    ned_from_camera: Array

    def of(self, chosen: NDArray[np.int64] | slice) -> Places:
        """Some of them."""
        return Places(
            self.t_ns[chosen], self.rotations[chosen], self.places[chosen],
            self.ned_from_camera[chosen],
        )  # fmt: skip

    @property
    def level(self) -> Array:
        """Chordal mean (3, 3) of the rotations from map to NED, by attitude."""
        return nearest_rotation((self.ned_from_camera @ self.rotations.transpose(0, 2, 1)).sum(0))


class TrackedPlaces:
    """Keeps frames of all maps relative to their keyframes; the last ones, of a bounded number."""

    def __init__(self) -> None:
        self._n = self._hover_from_ns = 0
        self._t_ns = np.zeros(256, np.int64)
        self._keyframe = np.zeros(256, np.int64)
        self._rows = np.zeros((256, 21))
        """Rotation (9) and translation (3) of the camera in its keyframe, attitude (9)."""

    def add(
        self, t_ns: int, keyframe_id: int, keyframe_from_camera: Pose, ned_from_body: Array
    ) -> None:
        """Add a frame; one too close to the last, or of a hover, is left out."""
        if self._n and abs(t_ns - self.newest_ns) < SPACING_NS:
            return
        if not self._n or keyframe_id != self._keyframe[self._n - 1]:
            self._hover_from_ns = t_ns + HOVER_NS
        if t_ns > self._hover_from_ns:
            return
        if self._n == MAX_PLACES:
            half = MAX_PLACES // 2
            for each in (self._t_ns, self._keyframe, self._rows):
                each[:half] = each[half : self._n]
            self._n = half
        if self._n == len(self._t_ns):
            self._t_ns = np.concatenate([self._t_ns, self._t_ns])
            self._keyframe = np.concatenate([self._keyframe, self._keyframe])
            self._rows = np.concatenate([self._rows, self._rows])
        self._t_ns[self._n], self._keyframe[self._n] = t_ns, keyframe_id
        pose = keyframe_from_camera
        self._rows[self._n] = np.concatenate(
            [pose.rotation.ravel(), pose.translation, ned_from_body.ravel()]
        )
        self._n += 1

    @property
    def newest_ns(self) -> int:
        """Time of the last frame that was added; 0 before the first."""
        return int(self._t_ns[self._n - 1]) if self._n else 0

    def since_ns(self, until_ns: int, lasting_ns: int) -> int:
        """Time since which frames until another time last so long, without pauses between them."""
        t_ns, since_ns = self._t_ns[: self._n], until_ns - lasting_ns
        for n in np.flatnonzero(np.diff(t_ns) > PAUSE_NS)[::-1]:
            if t_ns[n + 1] <= since_ns:
                break
            since_ns -= int(t_ns[n + 1] - t_ns[n])
        return since_ns

    def of(
        self, table: PoseTable, unit_of: Mapping[int, float], body_from_camera: Array,
        since_ns: int, until_ns: int,
    ) -> Places:  # fmt: skip
        """Frames of a map as it is now, from a time until before another.

        The table has `map_from_camera` of its keyframes, whose units have changed by `unit_of`
        since; `body_from_camera` (3, 3) is the mount.
        """
        t_ns, keyframe = self._t_ns[: self._n], self._keyframe[: self._n]
        order = np.argsort(table.ids)
        at = np.clip(np.searchsorted(table.ids, keyframe, sorter=order), 0, len(order) - 1)
        at = order[at]
        known = (table.ids[at] == keyframe) & (t_ns >= since_ns) & (t_ns < until_ns)
        chosen = np.flatnonzero(known)
        chosen = chosen[np.argsort(t_ns[chosen], kind="stable")]
        at, rows = at[chosen], self._rows[chosen]
        units = np.array([unit_of.get(int(k), 1.0) for k in keyframe[chosen]])
        rotations, inside = table.rotations[at], rows[:, 9:12] * units[:, None]
        return Places(
            t_ns[chosen], rotations @ rows[:, :9].reshape(-1, 3, 3),
            np.einsum("nij,nj->ni", rotations, inside) + table.translations[at],
            rows[:, 12:].reshape(-1, 3, 3) @ body_from_camera,
        )  # fmt: skip
