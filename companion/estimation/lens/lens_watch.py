"""Watch on the focal length: it is said where turns show another than is stated."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from companion.estimation.inertial.steady_level import SteadyLevel
from companion.estimation.lens.focal_length import Rays, focal_ratio, turn_across_rad
from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, angle_between
from companion.messages import Warned
from companion.slam.features.view import View
from companion.slam.map.sparse_map import SlamMap

OTHER_LENS = "focal length looks wrong: calibrate the lens"
LENS_FITS = "turns look as the focal length says"
FITS = 0.05
"""A focal length that is right within this, at two standard deviations, is as stated."""
TURN_RAD, LEAST_TURN_RAD = np.radians(4.0), np.radians(2.0)
"""A pair is taken once the camera has turned by the first, or at last by the second."""
LONGEST_NS = 1_500_000_000
"""Between the images of a pair: it still sees most of the same."""
N_KNOWN, MAX_PAIRS = 10, 100
SIGMAS, SURE_SIGMA = 4.0, 0.016
"""Difference that is said, in standard deviations, which must be small themselves."""
SIGMA_ALIKE = 0.01
"""Of what pairs after each other have in common: 0.052 at most by ten and more of ten flights
whose focal length was right, wherever in the flight they began."""
MOUNT_RAD = SURE_SIGMA
"""A mount that was off by more tells turns about other axes than images show."""
ROUNDS, CAUCHY = 10, 2.0


class FocalLength(NamedTuple):
    """True focal length over the stated one, its standard deviation, and how many pairs tell it."""

    ratio: float
    sigma: float
    n: int


class _Start(NamedTuple):
    t_ns: int
    rays: Rays


class LensWatch:
    """Collects turns of a camera on a body, from one view to another of the same map."""

    def __init__(self, camera: Camera, level: SteadyLevel) -> None:
        self._focal_px, self._level = camera.focal_px, level
        self._mount: Array | None = None
        self._map: SlamMap | None = None
        self._start: _Start | None = None
        self._pairs: list[tuple[float, float]] = []
        self._proven = False
        self.watches = True
        """False once the focal length is known: nothing that comes later would be said."""

    def end(
        self, view: View | None, slam_map: SlamMap, body_from_camera: Array, imu_delay_ns: int
    ) -> list[Warned]:
        """Compare what was seen in a frame, if it was tracked; what is to be said.

        The stamps of the IMU are later than the camera's by a delay. Where the mount (3, 3) has
        been corrected since, turns so far do not count.
        """
        before, self._mount = self._mount, body_from_camera
        if before is not None and angle_between(before, body_from_camera) > MOUNT_RAD:
            self._start = None
            self._pairs.clear()
            return []
        if not self.watches or view is None:
            return []
        n_before = len(self._pairs)
        self._take(view, slam_map, body_from_camera, imu_delay_ns)
        return self._judged(view.t_ns) if len(self._pairs) > n_before else []

    def _take(self, view: View, slam_map: SlamMap, body_from_camera: Array, delay_ns: int) -> None:
        start = self._start if slam_map is self._map else None
        self._map = slam_map
        turned = None
        if start is not None:
            turned = self._level.turn(start.t_ns + delay_ns, view.t_ns + delay_ns)
        if start is not None and turned is not None:
            turn = body_from_camera.T @ turned[0] @ body_from_camera
            turn_rad, late = turn_across_rad(turn), view.t_ns - start.t_ns > LONGEST_NS
            if turn_rad < TURN_RAD and not late:
                return
            if turn_rad >= LEAST_TURN_RAD:
                found = focal_ratio(start.rays, _rays_of(view), turn, turned[1], self._focal_px)
                self._pairs += [] if found is None else [found]
        self._start = _Start(view.t_ns, _rays_of(view))

    @property
    def estimate(self) -> FocalLength | None:
        """The focal length by all turns so far, with Cauchy's weights; None after too few."""
        if len(self._pairs) < N_KNOWN:
            return None
        ratio, sigma = np.array(self._pairs).T
        mean, weight = float(np.median(ratio)), sigma**-2.0
        for _ in range(ROUNDS):
            shared = weight / (1.0 + ((ratio - mean) / (CAUCHY * sigma)) ** 2)
            mean = float(shared @ ratio / shared.sum())
        spread = max(1.0, 1.48 * float(np.median(np.abs(ratio - mean) / sigma)))
        sigma_mean = spread * float(weight.sum() ** -0.5)
        return FocalLength(mean, float(np.hypot(sigma_mean, SIGMA_ALIKE)), len(ratio))

    def _judged(self, t_ns: int) -> list[Warned]:
        found = self.estimate
        if found is None or found.sigma > SURE_SIGMA:
            return []
        off = abs(found.ratio - 1.0)
        is_other = off > SIGMAS * found.sigma
        if is_other or found.n >= MAX_PAIRS:
            self.watches, self._map, self._start = False, None, None
        detail = f"it seems to be {found.ratio:.2f} +- {found.sigma:.2f} times what is stated"
        if is_other:
            return [Warned(t_ns, OTHER_LENS, detail)]
        if self._proven or off + 2.0 * found.sigma > FITS:
            return []
        self._proven = True
        return [Warned(t_ns, LENS_FITS, detail, good=True)]


def _rays_of(view: View) -> Rays:
    index = np.flatnonzero(view.point_ids >= 0)
    normalised = view.features.normalised if view.normalised is None else view.normalised
    return Rays(view.point_ids[index].copy(), normalised[index].copy())
