"""Yaw of a gimbal's head against the camera's in the map: a gimbal may drift, or change its zero.

From frame to frame a drift of a degree a second is nothing, and the vertical does not show it. Over
seconds the map keeps its heading, and the gimbal's yaw leaves it.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from companion.geometry.transforms import Array, vector_from_rotation

WINDOW_NS = 12_000_000_000
"""A drift of a third of a degree a second is found in it. Maps turn by some tenths in that time."""
SPACING_NS = 90_000_000
N_MEAN = 5
"""Samples at each end of the window that are averaged: half a second."""
LEAST_LIMIT_RAD, LIMIT_SIGMAS = np.radians(3.0), 3.0
"""Limit of the change: with angles that are good to a degree it is by chance one time in ten
thousand."""
AGAIN_NS = 3_000_000_000
"""The yaw has to be where it was for so long, to be believed again."""
STEADY_RAD, STEADY_NS = np.radians(1.0), 10_000_000_000
"""In another map, where nobody knows where it was, it has to be steady for as long."""


class HeadYaw:
    """Rotations of tracked frames, and the head's attitudes in; verdict on its yaw out."""

    def __init__(self, sigma_rad: float) -> None:
        self._limit_rad = max(float(LEAST_LIMIT_RAD), LIMIT_SIGMAS * sigma_rad)
        self._base: Array | None = None
        """Rotation (3, 3) of NED in the map, from which yaw counts; None before the first."""
        self._right: tuple[int, float] | None = None
        """Time and yaw when it was last believed, once it is not."""
        self._samples: deque[tuple[int, float]] = deque()
        self.off_rad = 0.0
        """Angle of the newest from where it was."""

    def reset(self) -> None:
        """Clear after another map became active."""
        self._base = None
        self._right = None if self._right is None else (self._right[0], float("nan"))
        self._samples.clear()
        self.off_rad = 0.0

    def take(self, t_ns: int, map_from_camera: Array, ned_from_camera: Array) -> None:
        """Add a tracked frame, rotations (3, 3): in the map, and by the gimbal."""
        map_from_ned = map_from_camera @ ned_from_camera.T
        if self._base is None:
            self._base = map_from_ned
        yaw = float(vector_from_rotation(self._base.T @ map_from_ned)[2])
        first = [yaw for _, yaw in self._samples][:N_MEAN] if self._right is None else []
        self.off_rad = _apart(yaw, float(np.median(first))) if len(first) == N_MEAN else 0.0
        if self._samples and t_ns - self._samples[-1][0] < SPACING_NS:
            return
        self._samples.append((t_ns, yaw))
        while t_ns - self._samples[0][0] > WINDOW_NS:
            self._samples.popleft()

    @property
    def doubted(self) -> bool:
        """True if the newest frame is off by more than angles are by chance."""
        return abs(self.off_rad) > self._limit_rad

    def moved_since_ns(self) -> int | None:
        """Time since which the yaw has moved away, which it has for half a second; else None."""
        if self._right is not None or len(self._samples) < 2 * N_MEAN or not self.doubted:
            return None
        yaws = [yaw for _, yaw in self._samples]
        was = float(np.median(yaws[:N_MEAN]))
        if abs(_apart(float(np.median(yaws[-N_MEAN:])), was)) < self._limit_rad:
            return None
        since_ns = next(
            t_ns for t_ns, yaw in self._samples if abs(_apart(yaw, was)) > 0.3 * self._limit_rad
        )
        self._right = since_ns, was
        return since_ns

    def fits_again(self, t_ns: int) -> bool:
        """True if it may be believed again: it never left, is back, or steady in another map."""
        if self._right is None:
            return True
        was, needed_ns, within = self._right[1], AGAIN_NS, 0.5 * self._limit_rad
        if np.isnan(was):
            needed_ns, within = STEADY_NS, float(STEADY_RAD)
        late = [yaw for at_ns, yaw in self._samples if at_ns >= t_ns - needed_ns]
        spans = bool(self._samples) and self._samples[0][0] <= t_ns - 0.9 * needed_ns
        if not late or not spans or t_ns - self._samples[-1][0] > AGAIN_NS:
            return False
        was = float(np.median(late)) if np.isnan(was) else was
        return max(abs(_apart(yaw, was)) for yaw in late) < within

    def believe(self) -> None:
        """Begin anew: it is believed again."""
        self._base, self._right, self.off_rad = None, None, 0.0
        self._samples.clear()


def _apart(a_rad: float, b_rad: float) -> float:
    return float((a_rad - b_rad + np.pi) % (2.0 * np.pi) - np.pi)
