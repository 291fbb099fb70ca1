"""Tilt of a map against the autopilot: change of the vertical while the map grows.

The axes of a map are arbitrary, so that only change is informative: where the initial motion is
wrong, the map bends, and its vertical drifts from that of the autopilot. A wrong mount or delay
moves it too, but consistently with body rotation, and is estimated first. A gimbal moves it by the
tilt of the body.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from companion.estimation.attitude.attitude_history import AttitudeHistory
from companion.geometry.transforms import (
    Array,
    nearest_rotation,
    rotation_from_vector,
    vectors_from_rotations,
)

WINDOW_NS = 15_000_000_000
SPACING_NS = 95_000_000
"""A little under the period of 10 frames/s: every frame of such a camera."""
RATE_STEP_NS = 40_000_000
SIGMA_RAD = np.radians(0.5)
"""Standard deviation of an autopilot's vertical against that of images, over some seconds."""
SIGMA_MOUNT_RAD, SIGMA_DELAY_S = np.radians(4.0), 0.06
MAX_MOUNT_RAD = np.radians(8.0)
"""While a body yaws, larger mount errors cannot be separated from a bending map."""
MIN_SAMPLES = 8
N_TRIMMED = 2
"""Outliers ignored at each end."""
ITERATIONS = 4

RotationOf = Callable[[int], Array | None]
"""`map_from_keyframe` (3, 3) at present; None where the keyframe is not in the map."""


@dataclass(frozen=True, slots=True, eq=False)
class TiltSpread:
    """Movement of the vertical of a map against the autopilot.

    `spread_rad` is its extent after removing a constant mount rotation and delay;
    `spread_with_gimbal_rad` after also removing any ratio of the body tilt, as by a gimbal.
    `map_from_ned` (3, 3) is by the newest samples, `mount_rad` the mount rotation removed.
    """

    spread_rad: float
    spread_with_gimbal_rad: Callable[[], float]
    map_from_ned: Array
    mount_rad: float
    span_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class _Sample:
    t_ns: int
    keyframe_id: int
    keyframe_from_camera: Array
    ned_from_body: Array
    rate_body_rad_s: Array


class MapTilt:
    """Collects tracked frames of one map after the other."""

    def __init__(self) -> None:
        self._waiting: deque[tuple[int, int, Array]] = deque(maxlen=200)
        self._samples: deque[_Sample] = deque()

    def reset(self) -> None:
        """Clear samples after another map became active."""
        self._waiting.clear()
        self._samples.clear()

    def take(
        self, t_ns: int, keyframe_id: int, keyframe_from_camera: Array, history: AttitudeHistory
    ) -> None:
        """Add the rotation (3, 3) of a frame; used once later attitudes have arrived."""
        if not self._waiting or t_ns - self._waiting[-1][0] >= SPACING_NS:
            self._waiting.append((t_ns, keyframe_id, keyframe_from_camera))
        while self._waiting and self._waiting[0][0] + RATE_STEP_NS <= history.newest_t_ns:
            at_ns, key, rotation = self._waiting.popleft()
            measured = history.with_rates_at(at_ns, RATE_STEP_NS)
            if measured is not None:
                self._samples.append(_Sample(at_ns, key, rotation, *measured))
        while self._samples and self._samples[0].t_ns < t_ns - WINDOW_NS:
            self._samples.popleft()

    def result(self, rotation_of: RotationOf, body_from_camera: Array) -> TiltSpread | None:
        """Movement of the vertical in the map as it is now; None with too little data."""
        rotations = {key: rotation_of(key) for key in {s.keyframe_id for s in self._samples}}
        map_from_camera, samples = [], []
        for sample in self._samples:
            rotation = rotations[sample.keyframe_id]
            if rotation is not None:
                map_from_camera.append(rotation @ sample.keyframe_from_camera)
                samples.append(sample)
        if len(samples) < MIN_SAMPLES:
            return None
        map_from_body = np.stack(map_from_camera) @ body_from_camera.T
        body = np.stack([s.ned_from_body for s in samples])
        rate_ned = np.matmul(body, np.stack([s.rate_body_rad_s for s in samples])[..., None])
        moved = (map_from_body, body, rate_ned[..., 0])
        tilt, mount_rad = _unexplained(*moved, gimbal=False)
        newest = slice(max(len(samples) - MIN_SAMPLES, 0), None)
        map_from_ned = np.matmul(map_from_body[newest], body[newest].transpose(0, 2, 1)).sum(0)

        def spread_with_gimbal_rad() -> float:
            return _spread(_unexplained(*moved, gimbal=True)[0])

        return TiltSpread(
            _spread(tilt), spread_with_gimbal_rad, nearest_rotation(map_from_ned), mount_rad,
            samples[-1].t_ns - samples[0].t_ns,
        )  # fmt: skip


def _unexplained(
    map_from_body: Array, ned_from_body: Array, rate_ned: Array, gimbal: bool
) -> tuple[Array, float]:
    """Residual tilt (N, 2) about north and east, and the mount rotation removed.

    Gauss-Newton over the tilt of the map, mount rotation, delay and, with `gimbal`, the compensated
    ratios of roll and pitch of the body.
    """
    back = ned_from_body.transpose(0, 2, 1)
    map_from_ned = nearest_rotation(np.matmul(map_from_body, back).sum(0))
    mount = np.eye(3)
    # from the vertical to the body's down axis, about the body's forward and right axes
    down = ned_from_body[:, :, 2]
    body_tilt = np.matmul(back, np.cross([0.0, 0.0, 1.0], down)[..., None])[:, :2, 0]
    compensated = ned_from_body[:, :2, :2] * body_tilt[:, None, :]
    n = 8 if gimbal else 6
    sigma = np.r_[np.zeros(2), np.full(3, SIGMA_MOUNT_RAD**-2.0), SIGMA_DELAY_S**-2.0, 0.0, 0.0]
    prior, x = np.diag(sigma[:n]), np.zeros(n)
    columns = [np.tile(np.eye(2), (len(back), 1, 1)), ned_from_body[:, :2], rate_ned[:, :2, None]]
    jacobian = np.concatenate([*columns, -compensated][: 4 if gimbal else 3], 2)

    def left() -> Array:
        # the first five are in `map_from_ned` and `mount` already; delay and gimbal are linear
        off = vectors_from_rotations(map_from_ned.T @ map_from_body @ mount.T @ back)[:, :2]
        out: Array = off - np.einsum("nij,j->ni", jacobian[:, :, 5:], x[5:])
        return out

    for _ in range(ITERATIONS):
        error = left()
        weight = 1.0 / (1.0 + ((error / SIGMA_RAD) ** 2).sum(1)) / SIGMA_RAD**2
        weighted = jacobian * weight[:, None, None]
        information = np.einsum("nij,nik->jk", weighted, jacobian) + prior + 1e-6 * np.eye(len(x))
        gradient = np.einsum("nij,ni->j", weighted, error) - prior @ x
        step = np.linalg.solve(information, gradient)
        x = x + step
        map_from_ned = map_from_ned @ rotation_from_vector(np.r_[step[:2], 0.0])
        x[2:5] *= min(1.0, float(MAX_MOUNT_RAD) / max(float(np.linalg.norm(x[2:5])), 1e-9))
        mount = rotation_from_vector(x[2:5])
        x[6:] = np.clip(x[6:], 0.0, 1.0)
    return left(), float(np.linalg.norm(x[2:5]))


def _spread(tilt: Array) -> float:
    """Extent of tilts (N, 2) along their principal direction, trimmed."""
    centred = tilt - np.median(tilt, axis=0)
    along = np.sort(centred @ np.linalg.svd(centred, full_matrices=False)[2][0])
    return float(along[-1 - N_TRIMMED] - along[N_TRIMMED])
