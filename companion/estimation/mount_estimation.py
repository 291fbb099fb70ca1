"""How the camera really sits on the body, and how late the autopilot's clock is, found in flight.

While the body turns, camera and autopilot see the same turns, each in its own axes and by its own
clock (hand-eye calibration: Daniilidis, IJRR 1999). Pairs of times up to some seconds apart are
compared, so that a slow drift of either does not matter.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from companion.estimation.motion_filter import AttitudeHistory
from companion.geometry.transforms import Array, rotation_from_vector, vectors_from_rotations

SPACING_NS = 150_000_000
KEPT = 500
LAGS = (3, 12, 60)
"""Samples between the two of a pair."""
SIGMA_RAD, SIGMA_DRIFT_RAD_S = np.radians(0.25), np.radians(0.04)
PRIOR_TURN_RAD, PRIOR_OFFSET_S = np.radians(4.0), 0.06
RATE_STEP_NS = 40_000_000
INFLATION = 3.0
"""Errors of pairs that lie near each other are alike: sigmas are so much larger."""
MIN_PAIRS = 150
MIN_TURNED_RAD, CERTAIN_RAD, CERTAIN_S = np.radians(1.5), np.radians(0.7), 0.012
ITERATIONS = 5


@dataclass(frozen=True, slots=True, eq=False)
class MountEstimate:
    """What the mount as it is stated lacks.

    `body_from_camera` (3, 3) corrected; `offset_s` is what the autopilot's stamps are late by. The
    sigmas are one standard deviation, of the turn about each camera axis (3,) and of the offset.
    `residual_rad` is the median disagreement that is left, `turned_rad` the usual turn.
    """

    body_from_camera: Array
    turn_camera_rad: Array
    offset_s: float
    sigma_turn_rad: Array
    sigma_offset_s: float
    residual_rad: float
    turned_rad: float

    @property
    def certain(self) -> bool:
        """Whether the body turned enough to tell."""
        return (
            self.turned_rad > float(MIN_TURNED_RAD)
            and float(self.sigma_turn_rad.max()) < float(CERTAIN_RAD)
            and self.sigma_offset_s < CERTAIN_S
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Sample:
    t_ns: int
    map_from_camera: Array
    ned_from_body: Array
    rate_body_rad_s: Array


class MountEstimator:
    """Takes the camera's attitude in one map after the other, and the autopilot's history."""

    def __init__(self, body_from_camera: Array) -> None:
        self._stated = body_from_camera
        self._waiting: deque[tuple[int, Array]] = deque(maxlen=30)
        self._samples: deque[_Sample] = deque(maxlen=KEPT)

    def __len__(self) -> int:
        return len(self._samples)

    def forget(self) -> None:
        """Another map is in use: its turns are not comparable with those of the last."""
        self._waiting.clear()
        self._samples.clear()

    def take(self, t_ns: int, map_from_camera: Array, history: AttitudeHistory) -> None:
        """Take the rotation (3, 3) of a tracked frame; used once attitudes around it have come."""
        newest = self._waiting[-1][0] if self._waiting else None
        if newest is None or t_ns - newest >= SPACING_NS:
            self._waiting.append((t_ns, map_from_camera))
        while self._waiting and self._waiting[0][0] + RATE_STEP_NS <= history.newest_t_ns:
            t_ns, rotation = self._waiting.popleft()
            told = history.with_rates_at(t_ns, RATE_STEP_NS)
            if told is not None:
                self._samples.append(_Sample(t_ns, rotation, *told))

    def estimate(self) -> MountEstimate | None:
        """The mount and the offset by all pairs kept; None while there are too few."""
        samples = list(self._samples)
        pairs = [(i, i + lag) for lag in LAGS for i in range(len(samples) - lag)]
        if len(pairs) < MIN_PAIRS:
            return None
        i, j = np.array(pairs).T
        t_s = np.array([s.t_ns - samples[0].t_ns for s in samples]) * 1e-9
        camera = np.stack([s.map_from_camera for s in samples])
        body = np.stack([s.ned_from_body for s in samples])
        rate = np.stack([s.rate_body_rad_s for s in samples])
        seen = np.matmul(camera[i].transpose(0, 2, 1), camera[j])
        flown = np.matmul(body[i].transpose(0, 2, 1), body[j])
        sigma = np.hypot(SIGMA_RAD, SIGMA_DRIFT_RAD_S * (t_s[j] - t_s[i]))
        turn, offset_s = np.zeros(3), 0.0
        information, error, chi2 = np.eye(4), np.zeros((len(i), 3)), 1.0
        for _ in range(ITERATIONS):
            mount = self._stated @ rotation_from_vector(turn)
            rate_i, rate_j = rate[i] @ mount, rate[j] @ mount
            expected = np.matmul(np.matmul(mount.T, flown), mount)
            back = expected.transpose(0, 2, 1)
            by_offset = np.matmul(back, rate_i[..., None])[..., 0] - rate_j
            error = vectors_from_rotations(np.matmul(back, seen)) + by_offset * offset_s
            jacobian = np.concatenate([back - np.eye(3), by_offset[..., None]], 2)
            size = np.linalg.norm(error, axis=1) / sigma
            weight = np.minimum(1.0, 2.5 / np.maximum(size, 1e-9)) / sigma**2
            weighted = jacobian * weight[:, None, None]
            prior = np.r_[np.full(3, PRIOR_TURN_RAD**-2.0), PRIOR_OFFSET_S**-2.0]
            information = np.einsum("nij,nik->jk", weighted, jacobian) + np.diag(prior)
            gradient = np.einsum("nij,ni->j", weighted, error) + prior * np.r_[turn, offset_s]
            step = -np.linalg.solve(information, gradient)
            turn, offset_s = turn + step[:3], offset_s + float(step[3])
            chi2 = float((size**2 * np.minimum(1.0, 2.5 / np.maximum(size, 1e-9))).mean() / 3)
        sigmas = np.sqrt(np.diag(np.linalg.inv(information)) * max(chi2, 0.05)) * INFLATION
        turned = np.maximum(
            np.linalg.norm(vectors_from_rotations(seen), axis=1),
            np.linalg.norm(vectors_from_rotations(flown), axis=1),
        )
        return MountEstimate(
            self._stated @ rotation_from_vector(turn), turn, offset_s, sigmas[:3],
            float(sigmas[3]), float(np.median(np.linalg.norm(error, axis=1))),
            float(np.median(turned)),
        )  # fmt: skip
