"""Agreement of camera and body rotation: regression of relative rotations.

A camera fixed to the body rotates as it does, however late and unevenly its frames are stamped: at
the best time offset the gain of camera on body rotation is one about each axis, and jitter leaves
errors proportional to the rate. A gimbal compensates rotation: the gain is near zero about its
stabilised axes.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.geometry.transforms import Array, vectors_from_rotations
from companion.telemetry import AttitudeSample

Ints = NDArray[np.int64]

WINDOW_NS = 10_000_000_000
MIN_SPAN_NS = 3_000_000_000
MIN_PAIRS = 20
SPACING_NS = 45_000_000
"""A little under the period of 20 frames/s: every frame of such a camera."""
LAGS_NS = (200_000_000, 500_000_000)
"""Two spans, so that a body oscillating at the period of one still shows in the other."""
OFFSETS_NS = np.arange(-240, 241, 20) * 1_000_000
"""Links and cameras have delays of up to 200 ms."""
MIN_ROTATION_RAD = np.radians(0.7)
"""RMS rotation of the body about an axis that determines its gain; attitude and image errors are
0.2 degrees each."""
STABILISED_GAIN, BODY_FIXED_GAIN, MAX_GAIN = 0.5, 0.75, 1.3
"""Jitter of 30 ms on a body oscillating at 2 Hz lowers the gain to 0.8; that of a gimbal is below
0.3."""
SIGMAS = 2.5
MAX_RESIDUAL_RAD, MAX_RESIDUAL_RATIO = np.radians(0.7), 0.4
"""RMS rotation unexplained by the body, absolute and as a ratio of the body's, above which the
camera rotates independently; jitter of 30 ms leaves ratios up to 0.3 over 0.2 s."""
KEPT_QUANTILE = 0.85
"""Larger rotations of the body are excluded: a heading reset of the autopilot rotates only its own
estimate, by tens of degrees, in at most one pair of eight."""
CORRECTED_RAD, CORRECTED_RATIO = np.radians(0.7), 0.1
"""A rotation that differs by more from what the autopilot's own rates add up to is a correction of
its estimate: PX4 turns its heading by some degrees a second after a take-off. The camera sees
nothing of such a rotation, gimbal or not."""
OVERLAP_INFLATION = 3.0
"""Reduction of the degrees of freedom by overlapping spans."""


@dataclass(frozen=True, slots=True, eq=False)
class RotationAgreement:
    """Regression of camera rotation on body rotation, about the body axes (3,) FRD.

    `gain` is nan about axes without body rotation; `sigma_gain` is its standard deviation.
    `body_rad` are RMS rotations of the body, `residual_rad` the median difference between camera
    and body rotation, both over `LAGS_NS`. Autopilot stamps are late by `offset_s` according to the
    rotations. `mount_correction` (3, 3) is the rotation of the mount that would reconcile both,
    None where none does.
    """

    gain: Array
    sigma_gain: Array
    body_rad: Array
    residual_rad: float
    offset_s: float
    mount_correction: Array | None

    @property
    def stabilised(self) -> bool:
        """True if the camera is stabilised about an axis about which the body rotates."""
        with np.errstate(invalid="ignore"):
            return bool((self.gain + SIGMAS * self.sigma_gain < STABILISED_GAIN).any())

    @property
    def body_fixed(self) -> bool:
        """True if the camera rotates with the body in roll and pitch, and by nothing else."""
        return bool(np.isfinite(self.gain[:2]).all()) and self.fits

    @property
    def fits(self) -> bool:
        """True if the camera turns as a gimbal's head does, which may be not at all."""
        known = np.isfinite(self.gain)
        gain, sigma = self.gain[known], self.sigma_gain[known]
        in_range = (gain - sigma > BODY_FIXED_GAIN) & (gain + sigma < MAX_GAIN)
        return bool(in_range.all()) and not self.rotates_independently

    @property
    def rotates_otherwise(self) -> bool:
        """True if the camera is known not to rotate as the body does."""
        return self.stabilised or self.rotates_independently

    @property
    def rotates_independently(self) -> bool:
        """True if the camera rotates by more than the body's rotation and clock errors explain."""
        body_rad = float(np.linalg.norm(self.body_rad))
        return self.residual_rad > max(float(MAX_RESIDUAL_RAD), MAX_RESIDUAL_RATIO * body_rad)


class RotationComparison:
    """Collects attitudes of both for some seconds and compares their relative rotations."""

    def __init__(self) -> None:
        self._body: deque[AttitudeSample] = deque()
        self._camera: deque[tuple[int, Array]] = deque()

    def add(self, sample: AttitudeSample) -> None:
        """Add an attitude of the autopilot; out-of-order samples are dropped."""
        if not self._body or sample.t_ns > self._body[-1].t_ns:
            self._body.append(sample)
            while self._body[0].t_ns < sample.t_ns - WINDOW_NS - int(OFFSETS_NS[-1]) * 2:
                self._body.popleft()

    def take(self, t_ns: int, map_from_camera: Array) -> None:
        """Add the rotation (3, 3) of a tracked frame."""
        if self._camera and t_ns - self._camera[-1][0] < SPACING_NS:
            return
        self._camera.append((t_ns, map_from_camera))
        while self._camera[0][0] < t_ns - WINDOW_NS:
            self._camera.popleft()

    def reset(self) -> None:
        """Clear camera rotations, which are not comparable between maps."""
        self._camera.clear()

    def result(self, body_from_camera: Array) -> RotationAgreement | None:
        """Agreement for a mount (3, 3); None with too little data."""
        if len(self._body) < 2 or not self._camera:
            return None
        known_ns = (
            self._body[0].t_ns - int(OFFSETS_NS[0]), self._body[-1].t_ns - int(OFFSETS_NS[-1])
        )  # fmt: skip
        camera = [(t, r) for t, r in self._camera if known_ns[0] <= t <= known_ns[1]]
        if not camera or camera[-1][0] - camera[0][0] < MIN_SPAN_NS:
            return None
        t_ns = np.array([t for t, _ in camera])
        first, second = _pairs(t_ns)
        if len(first) < MIN_PAIRS:
            return None
        rotation = np.stack([r for _, r in camera])
        camera_rotation = vectors_from_rotations(
            rotation[first].transpose(0, 2, 1) @ rotation[second]
        )
        camera_rotation = camera_rotation @ body_from_camera.T
        body_t_ns = np.array([each.t_ns for each in self._body])
        body_q = np.stack([np.asarray(each.ned_from_body, np.float64) for each in self._body])
        at = _interpolated(body_t_ns, body_q, t_ns[None] + OFFSETS_NS[:, None])
        body_rotation = _relative_rotations(at[:, first], at[:, second])
        left = np.median(np.linalg.norm(camera_rotation - body_rotation, axis=2), axis=1)
        best = int(left.argmin())
        span_s = float(t_ns[-1] - t_ns[0]) * 1e-9
        turned = self._turned(body_t_ns, t_ns + OFFSETS_NS[best])
        body_rotation = body_rotation[best]
        if turned is not None:
            apart = np.linalg.norm(body_rotation - (turned[second] - turned[first]), axis=1)
            size = np.linalg.norm(body_rotation, axis=1)
            kept = apart < CORRECTED_RAD + CORRECTED_RATIO * size
            if np.count_nonzero(kept) < MIN_PAIRS:
                return None
            camera_rotation, body_rotation = camera_rotation[kept], body_rotation[kept]
        return _regress(camera_rotation, body_rotation, span_s, float(OFFSETS_NS[best]) * 1e-9)

    def _turned(self, body_t_ns: Ints, at_ns: Ints) -> Array | None:
        """Sums (S, 3) of the body's rates up to some times, rad; None where rates are missing.

        Their differences are rotations in body axes, as long as these are small.
        """
        rates = [each.rates_body_rad_s for each in self._body if each.rates_body_rad_s is not None]
        if len(rates) < len(self._body):
            return None
        rate = np.stack(rates)
        step_s = np.diff(body_t_ns)[:, None] * 1e-9
        sums = np.concatenate([np.zeros((1, 3)), np.cumsum((rate[1:] + rate[:-1]) / 2 * step_s, 0)])
        return np.stack([np.interp(at_ns, body_t_ns, each) for each in sums.T], axis=1)


def _pairs(t_ns: Ints) -> tuple[Ints, Ints]:
    """Pairs (P,) of samples that are a lag apart, or little more."""
    out = []
    for lag_ns in LAGS_NS:
        second = np.searchsorted(t_ns, t_ns + lag_ns)
        first = np.flatnonzero(second < len(t_ns))
        second = second[first]
        near = t_ns[second] - t_ns[first] < 1.5 * lag_ns
        out.append(np.stack([first[near], second[near]]))
    first, second = np.concatenate(out, axis=1)
    return first, second


def _interpolated(t_ns: Ints, quaternions: Array, at_ns: Ints) -> Array:
    """Unit quaternions (..., 4), interpolated linearly at times within samples (S,), (S, 4)."""
    after = np.clip(np.searchsorted(t_ns, at_ns), 1, len(t_ns) - 1)
    a, b = quaternions[after - 1], quaternions[after]
    share = (at_ns - t_ns[after - 1]) / (t_ns[after] - t_ns[after - 1])
    sign = np.where((a * b).sum(-1, keepdims=True) < 0.0, -1.0, 1.0)
    mixed = a + np.clip(share, 0.0, 1.0)[..., None] * (sign * b - a)
    out: Array = mixed / np.linalg.norm(mixed, axis=-1, keepdims=True)
    return out


def _relative_rotations(a: Array, b: Array) -> Array:
    """Rotation vectors (..., 3) from quaternions a to b, in the axes of a."""
    w = (a * b).sum(-1)
    v = (
        a[..., :1] * b[..., 1:] - b[..., :1] * a[..., 1:]
        - np.cross(a[..., 1:], b[..., 1:])
    )  # fmt: skip
    v = np.where(w[..., None] < 0.0, -v, v)
    sine = np.linalg.norm(v, axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, np.abs(w)[..., None])
    out: Array = np.where(sine > 1e-9, angle / np.maximum(sine, 1e-12), 2.0) * v
    return out


def _regress(
    camera_rotation: Array, body_rotation: Array, span_s: float, offset_s: float
) -> RotationAgreement:
    n_free = max(len(LAGS_NS) * span_s / (1e-9 * LAGS_NS[-1]) / OVERLAP_INFLATION, 1.0)
    kept = np.abs(body_rotation) <= np.quantile(np.abs(body_rotation), KEPT_QUANTILE, axis=0)
    n = kept.sum(0)
    body = np.sqrt((body_rotation * body_rotation * kept).sum(0) / n)
    gain = (camera_rotation * body_rotation * kept).sum(0) / np.maximum(
        (body_rotation * body_rotation * kept).sum(0), 1e-12
    )
    rest = np.sqrt((((camera_rotation - gain * body_rotation) ** 2) * kept).sum(0) / n)
    sigma = rest / np.maximum(body, 1e-9) / np.sqrt(n_free)
    still = body < MIN_ROTATION_RAD
    gain, sigma = np.where(still, np.nan, gain), np.where(still, np.nan, sigma)
    residual_rad = float(np.median(np.linalg.norm(camera_rotation - body_rotation, axis=1)))
    return RotationAgreement(
        gain, sigma, body, residual_rad, offset_s, _mount_correction(camera_rotation, body_rotation)
    )


def _mount_correction(camera_rotation: Array, body_rotation: Array) -> Array | None:
    """The rotation from camera rotations to body rotations (Kabsch), where one fits."""
    u, size, vt = np.linalg.svd(body_rotation.T @ camera_rotation)
    rms = np.sqrt(size / len(camera_rotation))
    if rms[1] < MIN_ROTATION_RAD:
        return None  # rotation about one axis does not determine the mount
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    rest = np.linalg.norm(camera_rotation @ rotation.T - body_rotation, axis=1)
    usual = np.linalg.norm(body_rotation, axis=1)
    if np.median(rest) > MAX_RESIDUAL_RATIO * np.sqrt((usual * usual).mean()):
        return None
    out: Array = rotation
    return out
