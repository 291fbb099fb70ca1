"""Search of a mount of which nothing is known, while the vehicle is turned by hand.

Rotation vectors of body and camera over the same span are one vector in two sets of axes; the
rotation between the axes is found over all spans (Kabsch, Acta Cryst. A 1976), without those that
do not fit, then refined with the delay of the autopilot's stamps by `MountEstimator`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.estimation.attitude.attitude_history import AttitudeHistory
from companion.estimation.attitude.mount_estimation import (
    MAX_RESIDUAL_RAD,
    MountEstimate,
    MountEstimator,
)
from companion.geometry.transforms import Array
from companion.telemetry import AttitudeSample

AXES = ("roll", "pitch", "yaw")
ENOUGH_RAD = np.radians(30.0)
"""Range of roll, pitch and yaw that a search wants: attitude errors of a degree or two then turn
the mount by a tenth of it."""
MIN_KEPT_RAD = np.radians(5.0)
"""Smaller rotations say little about an axis."""
FITS_RATIO, FITS_RAD = 0.25, np.radians(4.0)
"""Misfit of a pair, relative to its rotation and absolute, beyond which it is left out."""
ROUNDS = 4
MIN_FITTING = 0.6
"""Least share of pairs that fit; fewer, and the camera does not turn with the body."""
CERTAIN_RAD = np.radians(1.0)
"""Largest standard deviation about any axis. How late stamps are need not be known for it."""


@dataclass(frozen=True, slots=True, eq=False)
class MountSearched:
    """State of a search. `turned_rad` (3,) are the ranges of roll, pitch and yaw so far."""

    n_samples: int
    turned_rad: Array
    estimate: MountEstimate | None = None
    """None while nothing can be said."""
    fits: bool = False
    """True if the camera turns with the body, as far as is known."""

    @property
    def missing(self) -> tuple[str, ...]:
        """Axes about which the body is to be turned more."""
        return tuple(a for a, rad in zip(AXES, self.turned_rad, strict=True) if rad < ENOUGH_RAD)

    @property
    def is_certain(self) -> bool:
        """True if the rotations, though small ones, tell the mount well enough to be stated."""
        found = self.estimate
        return (
            found is not None and self.fits and found.residual_rad < MAX_RESIDUAL_RAD
            and float(found.sigma_turn_rad.max()) < CERTAIN_RAD
        )  # fmt: skip

    @property
    def is_found(self) -> bool:
        """True if it was also turned far enough about all axes, as by hand it can be."""
        return self.is_certain and not self.missing


class MountSearch:
    """Collects attitudes, and rotations of a camera in one map after the other."""

    def __init__(self) -> None:
        self._history = AttitudeHistory()
        self._estimator = MountEstimator(np.eye(3))
        self._map: int | None = None

    def __len__(self) -> int:
        return len(self._estimator)

    def add(self, sample: AttitudeSample) -> None:
        """Add an attitude of the autopilot."""
        self._history.add(sample)

    def take(self, t_ns: int, map_from_camera: Array, map_number: int) -> None:
        """Add the rotation (3, 3) of a tracked frame in a map; another map begins a new search."""
        if map_number != self._map:
            self._estimator.reset()
            self._map = map_number
        self._estimator.take(t_ns, map_from_camera, self._history)

    def result(self) -> MountSearched:
        """The mount by all rotations so far."""
        n, rotations = len(self._estimator), self._estimator.rotations()
        if rotations is None:
            return MountSearched(n, np.zeros(3))
        camera, body = rotations
        turned = np.ptp(_euler(self._estimator.attitudes()), axis=0)
        found, share = _axes_between(camera, body)
        if found is None:
            return MountSearched(n, turned)
        self._estimator.state(found)
        return MountSearched(n, turned, self._estimator.estimate(), share > MIN_FITTING)


def _euler(ned_from_body: Array) -> Array:
    """Roll, pitch and yaw (N, 3), rad, of attitudes (N, 3, 3); yaw without leaps."""
    roll = np.arctan2(ned_from_body[:, 2, 1], ned_from_body[:, 2, 2])
    pitch = -np.arcsin(np.clip(ned_from_body[:, 2, 0], -1.0, 1.0))
    yaw = np.unwrap(np.arctan2(ned_from_body[:, 1, 0], ned_from_body[:, 0, 0]))
    return np.stack([roll, pitch, yaw], 1)


def _axes_between(camera: Array, body: Array) -> tuple[Array | None, float]:
    """Rotation `body_from_camera` (3, 3) of rotation vectors (N, 3), and the share that fits it."""
    size = np.linalg.norm(body, axis=1)
    told = (size > MIN_KEPT_RAD) & (np.linalg.norm(camera, axis=1) > MIN_KEPT_RAD)
    if told.sum() < 3:
        return None, 0.0
    kept, rotation = told, np.eye(3)
    for _ in range(ROUNDS):
        u, _, vt = np.linalg.svd(body[kept].T @ camera[kept])
        rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
        off = np.linalg.norm(body - camera @ rotation.T, axis=1)
        kept = told & (off < np.maximum(FITS_RATIO * size, FITS_RAD))
        if kept.sum() < 3:
            return None, 0.0
    return rotation, float(kept.sum() / told.sum())
