"""Yaw of a gimbal's head against the camera's in the map: a gimbal may drift, or change its zero.

From frame to frame a drift of a degree a second is nothing, and the vertical does not show it. Over
seconds the map keeps its heading, and the gimbal's yaw leaves it. An autopilot that corrects its
heading turns what a gimbal tells against it, or follows it, by as much: that is no fault.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from companion.geometry.transforms import Array, vector_from_rotation, yaw_angle

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
FAR_RAD, FAR_NS = np.radians(20.0), 1_000_000_000
"""Limit against the heading of the georeference, and how long it lasts: of a path of some metres
that is good to a few degrees, and compasses are off by ten."""


class _Yaw(NamedTuple):
    """Yaw of the head against the map, rad: as told, and without corrections of the heading."""

    t_ns: int
    told: float
    by_rates: float


class HeadYaw:
    """Rotations of tracked frames, and the head's attitudes in; verdict on its yaw out."""

    def __init__(self, sigma_rad: float) -> None:
        self._limit_rad = max(float(LEAST_LIMIT_RAD), LIMIT_SIGMAS * sigma_rad)
        self._base: Array | None = None
        """Rotation (3, 3) of NED in the map, from which yaw counts; None before the first."""
        self._map_from_ned: Array | None = None
        """Rotation (3, 3) by the newest frame."""
        self._right: _Yaw | None = None
        """Yaw when it was last believed, once it is not; nan in another map since."""
        self._samples: deque[_Yaw] = deque()
        self._far_since_ns: int | None = None
        self.off_rad = 0.0
        """Angle of the newest from where it was."""

    def reset(self) -> None:
        """Clear after another map became active."""
        self._base = self._map_from_ned = self._far_since_ns = None
        if self._right is not None:
            self._right = _Yaw(self._right.t_ns, float("nan"), float("nan"))
        self._samples.clear()
        self.off_rad = 0.0

    def take(
        self, t_ns: int, map_from_camera: Array, ned_from_camera: Array, corrected_rad: float = 0.0
    ) -> None:
        """Add a tracked frame, rotations (3, 3): in the map, and by the gimbal.

        The autopilot has corrected its heading by `corrected_rad` so far.
        """
        self._map_from_ned = map_from_ned = map_from_camera @ ned_from_camera.T
        if self._base is None:
            self._base = map_from_ned
        told = float(vector_from_rotation(self._base.T @ map_from_ned)[2])
        yaw = _Yaw(t_ns, told, told + corrected_rad)
        was = self._median(slice(N_MEAN)) if self._right is None else None
        self.off_rad = 0.0 if was is None else _off(yaw, was)
        if self._samples and t_ns - self._samples[-1].t_ns < SPACING_NS:
            return
        self._samples.append(yaw)
        while t_ns - self._samples[0].t_ns > WINDOW_NS:
            self._samples.popleft()

    @property
    def doubted(self) -> bool:
        """True if the newest frame is off by more than angles are by chance."""
        return abs(self.off_rad) > self._limit_rad or self._far_since_ns is not None

    def moved_since_ns(self) -> int | None:
        """Time since which the yaw has moved away, which it has for half a second; else None."""
        was, now = self._median(slice(N_MEAN)), self._median(slice(-N_MEAN, None))
        enough = len(self._samples) >= 2 * N_MEAN and self._right is None and self.doubted
        if not enough or was is None or now is None or abs(_off(now, was)) < self._limit_rad:
            return None
        self._right = was
        return next(y.t_ns for y in self._samples if abs(_off(y, was)) > 0.3 * self._limit_rad)

    def far_since_ns(self, t_ns: int, ned_from_map: Array | None) -> int | None:
        """Time since which it has been far from the heading of the georeference; else None.

        `ned_from_map` (3, 3) is its rotation, None where unknown.
        """
        if ned_from_map is None or self._map_from_ned is None:
            off_rad = 0.0
        else:
            off_rad = yaw_angle(ned_from_map @ self._map_from_ned)
        if abs(off_rad) < float(FAR_RAD):
            self._far_since_ns = None
            return None
        if self._far_since_ns is None:
            self._far_since_ns = t_ns
        self.off_rad = off_rad
        return self._far_since_ns if t_ns - self._far_since_ns >= FAR_NS else None

    def fits_again(self, t_ns: int) -> bool:
        """True if it may be believed again: it is back, steady in another map, or never left."""
        was = self._right
        if self._far_since_ns is not None:
            return False
        if was is None:
            return True
        needed_ns, within = AGAIN_NS, 0.5 * self._limit_rad
        if np.isnan(was.told):
            needed_ns, within = STEADY_NS, float(STEADY_RAD)
        late = [yaw for yaw in self._samples if yaw.t_ns >= t_ns - needed_ns]
        spans = bool(late) and self._samples[0].t_ns <= t_ns - 0.9 * needed_ns
        if not spans or t_ns - late[-1].t_ns > AGAIN_NS:
            return False
        if np.isnan(was.told):
            was = late[len(late) // 2]
        return max(abs(_off(yaw, was)) for yaw in late) < within

    def believe(self) -> None:
        """Begin anew: it is believed again."""
        self._base = self._right = None
        self.off_rad = 0.0
        self._samples.clear()

    def _median(self, part: slice) -> _Yaw | None:
        """Medians of some of the samples; None with too few."""
        some = list(self._samples)[part]
        if len(some) < N_MEAN:
            return None
        # about one of them: angles may wrap
        first = some[0]
        told = first.told + float(np.median([_apart(y.told, first.told) for y in some]))
        by_rates = first.by_rates + float(
            np.median([_apart(y.by_rates, first.by_rates) for y in some])
        )
        return _Yaw(first.t_ns, told, by_rates)


def _off(yaw: _Yaw, was: _Yaw) -> float:
    """Angle from one to the other, the lesser of both."""
    told, by_rates = _apart(yaw.told, was.told), _apart(yaw.by_rates, was.by_rates)
    return min(told, by_rates, key=abs)


def _apart(a_rad: float, b_rad: float) -> float:
    return float((a_rad - b_rad + np.pi) % (2.0 * np.pi) - np.pi)
