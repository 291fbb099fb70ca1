"""Online estimation of the mount rotation and of the autopilot's stamp delay.

Camera and autopilot measure the same rotations in their own axes and clocks (hand-eye calibration:
Daniilidis, IJRR 1999). Pairs of samples up to some seconds apart are compared, so that slow drift
of either does not matter.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.estimation.attitude.attitude_history import AttitudeHistory
from companion.geometry.transforms import Array, rotation_from_vector, vectors_from_rotations

SPACING_NS = 150_000_000
MAX_SAMPLES = 500
LAGS = (3, 12, 60)
"""Samples between the two of a pair."""
SIGMA_RAD, SIGMA_DRIFT_RAD_S = np.radians(0.25), np.radians(0.04)
PRIOR_TURN_RAD, PRIOR_OFFSET_S = np.radians(4.0), 0.06
RATE_STEP_NS = 40_000_000
CORRELATION_INFLATION = 3.0
"""Inflation of sigmas, as errors of neighbouring pairs are correlated."""
MIN_PAIRS = 150
MIN_ROTATION_RAD, CERTAIN_RAD, CERTAIN_S = np.radians(1.5), np.radians(0.7), 0.012
MAX_RESIDUAL_RAD = np.radians(2.5)
"""Largest median residual of a mount to be stated: beyond, the lens is wrong, or the camera hangs
in a gimbal. A camera on a network, stamped as its images arrive, 50 ms to and fro, is turned by 1.5
degrees in that time."""
FITS_RAD = np.radians(1.5)
"""Correction up to which a mount is as stated, as well as it can be measured by hand."""
ITERATIONS = 5


@dataclass(frozen=True, slots=True, eq=False)
class MountEstimate:
    """Correction of the stated mount.

    `body_from_camera` (3, 3) corrected; `offset_s` is the delay of autopilot stamps. The sigmas are
    one standard deviation, of the rotation about each camera axis (3,) and of the offset.
    `residual_rad` is the median residual, `rotation_rad` the median rotation.
    """

    body_from_camera: Array
    turn_camera_rad: Array
    offset_s: float
    sigma_turn_rad: Array
    sigma_offset_s: float
    residual_rad: float
    rotation_rad: float

    @property
    def certain(self) -> bool:
        """True if the body rotated enough for the estimate."""
        return (
            self.rotation_rad > float(MIN_ROTATION_RAD)
            and float(self.sigma_turn_rad.max()) < float(CERTAIN_RAD)
            and self.sigma_offset_s < CERTAIN_S
        )

    @property
    def fits(self) -> bool:
        """True if the camera sits as stated."""
        return (
            self.certain
            and self.residual_rad < float(MAX_RESIDUAL_RAD)
            and float(np.linalg.norm(self.turn_camera_rad)) < float(FITS_RAD)
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Sample:
    t_ns: int
    map_from_camera: Array
    ned_from_body: Array
    rate_body_rad_s: Array


class MountEstimator:
    """Collects camera rotations of one map after the other, with attitudes."""

    def __init__(self, body_from_camera: Array) -> None:
        self._stated = body_from_camera
        self._waiting: deque[tuple[int, Array]] = deque(maxlen=30)
        self._samples: deque[_Sample] = deque(maxlen=MAX_SAMPLES)

    def __len__(self) -> int:
        return len(self._samples)

    def state(self, body_from_camera: Array) -> None:
        """State another mount, from which the next estimate begins."""
        self._stated = body_from_camera

    def reset(self) -> None:
        """Clear rotations, which are not comparable between maps."""
        self._waiting.clear()
        self._samples.clear()

    def take(self, t_ns: int, map_from_camera: Array, history: AttitudeHistory) -> None:
        """Add the rotation (3, 3) of a tracked frame; used once later attitudes have arrived."""
        newest = self._waiting[-1][0] if self._waiting else None
        if newest is None or t_ns - newest >= SPACING_NS:
            self._waiting.append((t_ns, map_from_camera))
        while self._waiting and self._waiting[0][0] + RATE_STEP_NS <= history.newest_t_ns:
            t_ns, rotation = self._waiting.popleft()
            measured = history.with_rates_at(t_ns, RATE_STEP_NS)
            if measured is not None:
                self._samples.append(_Sample(t_ns, rotation, *measured))

    def attitudes(self) -> Array:
        """Attitudes `ned_from_body` (N, 3, 3) of all samples."""
        return np.array([s.ned_from_body for s in self._samples]).reshape(-1, 3, 3)

    def rotations(self) -> tuple[Array, Array] | None:
        """Rotation vectors (N, 3) of the camera and of the body over all pairs, each in its axes.

        None with too few.
        """
        turns = self._turns(_pairs(len(self._samples)))
        if turns is None:
            return None
        return vectors_from_rotations(turns[0]), vectors_from_rotations(turns[1])

    def _turns(self, pairs: NDArray[np.int64]) -> tuple[Array, Array] | None:
        """Rotations (N, 3, 3) of the camera and of the body over these pairs; None with too few."""
        if len(pairs) < MIN_PAIRS:
            return None
        i, j = pairs.T
        camera = np.stack([s.map_from_camera for s in self._samples])
        body = np.stack([s.ned_from_body for s in self._samples])
        return (
            np.matmul(camera[i].transpose(0, 2, 1), camera[j]),
            np.matmul(body[i].transpose(0, 2, 1), body[j]),
        )

    def estimate(self) -> MountEstimate | None:
        """Mount and offset from all pairs; None with too few."""
        samples = list(self._samples)
        pairs = _pairs(len(samples))
        turns = self._turns(pairs)
        if turns is None:
            return None
        (i, j), (camera_rotation, body_rotation) = pairs.T, turns
        t_s = np.array([s.t_ns - samples[0].t_ns for s in samples]) * 1e-9
        rate = np.stack([s.rate_body_rad_s for s in samples])
        sigma = np.hypot(SIGMA_RAD, SIGMA_DRIFT_RAD_S * (t_s[j] - t_s[i]))
        rotvec, offset_s = np.zeros(3), 0.0
        information, error, chi2 = np.eye(4), np.zeros((len(i), 3)), 1.0
        for _ in range(ITERATIONS):
            mount = self._stated @ rotation_from_vector(rotvec)
            rate_i, rate_j = rate[i] @ mount, rate[j] @ mount
            expected = np.matmul(np.matmul(mount.T, body_rotation), mount)
            back = expected.transpose(0, 2, 1)
            by_offset = np.matmul(back, rate_i[..., None])[..., 0] - rate_j
            error = vectors_from_rotations(np.matmul(back, camera_rotation)) + by_offset * offset_s
            jacobian = np.concatenate([back - np.eye(3), by_offset[..., None]], 2)
            size = np.linalg.norm(error, axis=1) / sigma
            weight = np.minimum(1.0, 2.5 / np.maximum(size, 1e-9)) / sigma**2
            weighted = jacobian * weight[:, None, None]
            prior = np.r_[np.full(3, PRIOR_TURN_RAD**-2.0), PRIOR_OFFSET_S**-2.0]
            information = np.einsum("nij,nik->jk", weighted, jacobian) + np.diag(prior)
            gradient = np.einsum("nij,ni->j", weighted, error) + prior * np.r_[rotvec, offset_s]
            step = -np.linalg.solve(information, gradient)
            rotvec, offset_s = rotvec + step[:3], offset_s + float(step[3])
            chi2 = float((size**2 * np.minimum(1.0, 2.5 / np.maximum(size, 1e-9))).mean() / 3)
        sigmas = (
            np.sqrt(np.diag(np.linalg.inv(information)) * max(chi2, 0.05)) * CORRELATION_INFLATION
        )
        rotation_size = np.maximum(
            np.linalg.norm(vectors_from_rotations(camera_rotation), axis=1),
            np.linalg.norm(vectors_from_rotations(body_rotation), axis=1),
        )
        return MountEstimate(
            self._stated @ rotation_from_vector(rotvec), rotvec, offset_s, sigmas[:3],
            float(sigmas[3]), float(np.median(np.linalg.norm(error, axis=1))),
            float(np.median(rotation_size)),
        )  # fmt: skip


def _pairs(n_samples: int) -> NDArray[np.int64]:
    """Pairs (N, 2) of samples that are some LAGS apart."""
    pairs = [(i, i + lag) for lag in LAGS for i in range(n_samples - lag)]
    return np.array(pairs, np.int64).reshape(-1, 2)
