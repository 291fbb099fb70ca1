"""Scale of a map by accelerometers, without any place or distance being measured.

What makes scale observable is a change of acceleration; in a straight and steady flight there is
none, and the standard deviation says so (Martinelli, "Vision and IMU Data Fusion: Closed-Form
Solutions", IEEE T-RO 2012).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from companion.estimation.georeference.inertial_alignment import Fit, InertialAlignment, nodes_of
from companion.estimation.georeference.steady_places import steadied
from companion.estimation.georeference.tracked_places import Places
from companion.estimation.georeference.trajectory_alignment import Scale
from companion.estimation.inertial.acceleration_integral import AccelerationIntegral
from companion.estimation.inertial.inertial_motion import InertialStart
from companion.geometry.transforms import Array

NOISES = tuple(0.5e-4 * 2.0**n for n in range(8))
"""White noise of a frame's place, units: 0.025 to 3.2 pixels of 500 at the typical distance of what
the first keyframes see; after a climb from the ground all is seen from four times as far."""
FIRST_SCALE = 30.0
"""Metres per unit that the first weights are for. The unit is the typical distance of what the
first two keyframes see."""
LEAST_SCALE, MOST_SCALE = 0.1, 1000.0
ROUNDS, SAME = 6, 0.02
"""With the weights of the last scale, until it changes by less."""
SIGMA_SENSITIVITY = 0.01
"""Of an accelerometer's own scale: datasheets of those in autopilots state 0.5 to 1 %."""
MOST_SUSTAINED_M_S2 = 2.0
"""A vehicle does not accelerate so on average over seconds; turned axes of the IMU look so."""
SPACING_NS, BETWEEN_M = 300_000_000, 3e-4
"""Of nodes; and what white noise of the IMU may move a body by from a node to a frame about it,
which counts for nothing. Motors' vibration, aliased to 0.5 m/s2, moves it by as much in 0.05 s:
scales by frames later than that were 2.5 % small, and 5 % large where the map was better still."""
LEAST_NODES, LEAST_NODES_STARTED = 11, 4
"""Without and with a known velocity at the first."""
MOST_NODES, MOST_NODES_FINAL = 300, 1000
"""The latest 90 s, as the map drifts; of a finished one 5 minutes."""
GROWN = 1.2
"""More frames by so much, until noises are compared again."""


class InertialScale:
    """Scale of one map while it grows.

    `start` is the motion at its first frame, where inertial navigation knew it.
    """

    def __init__(
        self, lever_camera_m: Array, start: InertialStart | None = None,
        most_nodes: int = MOST_NODES,
    ) -> None:  # fmt: skip
        self._lever_camera_m, self._start, self._most_nodes = lever_camera_m, start, most_nodes
        self._least_nodes = LEAST_NODES if start is None else LEAST_NODES_STARTED
        self._scale = FIRST_SCALE
        self._noise = 3
        """Index of the likeliest of NOISES."""
        self._n_compared = 0
        """Frames at the last comparison of noises."""

    @property
    def window_ns(self) -> int:
        """Time before the newest frame from which on frames are of use."""
        return self._most_nodes * SPACING_NS

    def update(
        self, places: Places, integral: AccelerationIntegral, body_from_camera: Array,
        delay_ns: int = 0,
    ) -> Scale | None:  # fmt: skip
        """Scale by frames as the map has them now; None while it is unknown.

        `body_from_camera` (3, 3) is the mount; autopilot stamps are late by `delay_ns`.
        """
        sums, known = integral.at(places.t_ns + delay_ns)
        if self._start is not None:
            known = known & (places.t_ns >= self._start.t_ns)
        places, sums = places.of(np.flatnonzero(known)), sums[known]
        nodes = nodes_of(places.t_ns, SPACING_NS)[-self._most_nodes :]
        if len(nodes) < self._least_nodes:
            return None
        places, sums = places.of(slice(nodes[0], None)), sums[nodes[0] :]
        turns = integral.turns
        places = steadied(
            places, *turns.at(places.t_ns + delay_ns), body_from_camera, turns.density_rad_s
        )
        nodes = nodes - nodes[0]
        near = near_nodes(places.t_ns, nodes, integral.density_m_s2)
        places, sums, nodes = places.of(near), sums[near], np.searchsorted(near, nodes)
        start = self._start
        if start is not None and start.t_ns != places.t_ns[0]:
            start = None
        aligned = InertialAlignment(
            places, sums, nodes, places.level, self._lever_camera_m,
            integral.density_m_s2, start,
        )  # fmt: skip
        if aligned.sustained_m_s2 > MOST_SUSTAINED_M_S2:
            return None
        found = self._weighted(aligned)
        if len(sums) > GROWN * self._n_compared:  # also where a wrong noise lets no scale settle
            self._n_compared = len(sums)
            if self._compare_noises(aligned):
                found = self._weighted(aligned)
        if found is None:
            self._scale = FIRST_SCALE
            return None
        unlikely = float(np.sqrt(max(found.squared, 1.0)))
        return Scale(
            self._scale, float(np.hypot(unlikely * found.sigma, SIGMA_SENSITIVITY)),
            "accelerometers", aligned.n_nodes, found.down_map, unlikely * found.sigma_down_rad,
        )  # fmt: skip

    def _weighted(self, aligned: InertialAlignment) -> Fit | None:
        """Fit with weights for the scale that is found."""
        for _ in range(ROUNDS):
            found = aligned.fit(self._scale, NOISES[self._noise])
            if found is None or not LEAST_SCALE < found.scale < MOST_SCALE:
                return None
            changed = abs(float(np.log(found.scale / self._scale)))
            self._scale = found.scale
            if changed < SAME:
                return found
        return None

    def _compare_noises(self, aligned: InertialAlignment) -> bool:
        """Take the likeliest noise, from the last one up or down; True where it is another."""
        before, found = self._noise, {}
        for step in (-1, 1):
            for n in range(before, len(NOISES) if step > 0 else -1, step):
                fit = aligned.fit(self._scale, NOISES[n])
                found[n] = -np.inf if fit is None else fit.log_likelihood
                if found[n] < found.get(n - step, -np.inf):
                    break
        self._noise = max(found, key=lambda n: found[n])
        return self._noise != before


def near_nodes(
    t_ns: NDArray[np.int64], nodes: NDArray[np.int64], density_m_s2: float
) -> NDArray[np.int64]:
    """Indices of the times (N,) so near to one of their nodes, the first among them, as counts.

    That is by accelerometers of a noise density, m/s2 per root of Hz; nodes are always.
    """
    within_ns = 1e9 * float(np.cbrt(3.0 * (BETWEEN_M / density_m_s2) ** 2))
    at = np.searchsorted(nodes, np.arange(len(t_ns)), side="right")
    before_ns = t_ns - t_ns[nodes[at - 1]]
    after_ns = np.abs(t_ns[nodes[np.minimum(at, len(nodes) - 1)]] - t_ns)
    return np.flatnonzero(np.minimum(before_ns, after_ns) <= within_ns)


def settled(
    places: Places, integral: AccelerationIntegral, lever_camera_m: Array,
    body_from_camera: Array, delay_ns: int = 0, start: InertialStart | None = None,
) -> Scale | None:  # fmt: skip
    """Scale by the frames of a finished map; None while it is unknown."""
    estimate = InertialScale(lever_camera_m, start, MOST_NODES_FINAL)
    return estimate.update(places, integral, body_from_camera, delay_ns)
