"""Whether the camera turns as the body does: camera turns regressed on the autopilot's.

A camera that is fixed to the body turns as it turns, however late and unevenly its frames are
stamped: after the best offset in time the gain of its turns on the body's is one about each axis,
and jitter leaves errors in proportion to the rate alone. A gimbal takes turns away: the gain is
near zero about the axes that it holds.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.geometry.transforms import Array, vectors_from_rotations
from companion.messages import AttitudeSample

Ints = NDArray[np.int64]

KEPT_NS = 10_000_000_000
LEAST_SPAN_NS = 3_000_000_000
SPACING_NS = 45_000_000
"""A little under the period of 20 frames/s: every frame of such a camera."""
LAGS_NS = (200_000_000, 500_000_000)
"""Rotations over two spans, so that a body that rocks in one of them still shows in the other."""
OFFSETS_NS = np.arange(-240, 241, 20) * 1_000_000
"""Links and cameras are late by up to 200 ms."""
LEAST_TURN_RAD = np.radians(0.7)
"""RMS turn of the body about an axis that tells its gain: attitude and image each err by 0.2."""
HELD_GAIN, FOLLOWED_GAIN, MOST_GAIN = 0.5, 0.75, 1.3
"""Jitter of 30 ms on a body that rocks at 2 Hz lowers the gain to 0.8; a gimbal's is below 0.3."""
SIGMAS = 2.5
ALONE_RAD, ALONE_SHARE = np.radians(0.7), 0.4
"""RMS turn that the body does not explain, at least and as a share of the body's, that says that
the camera turns by itself; jitter of 30 ms leaves up to 0.3 of turns over 0.2 s."""
KEPT_SHARE = 0.85
"""The greatest turns of the body are left out: where an autopilot sets its heading anew, it turns
by tens of degrees in itself alone, which is in one pair of eight at most."""
FILTERED = 3.0
"""RelativeRotationFactor that overlap count for so much less."""


@dataclass(frozen=True, slots=True, eq=False)
class Following:
    """How camera turns follow body turns: about the body's axes (3,) forward, right, down.

    `gain` is nan about axes about which the body did not turn; `sigma_gain` is its standard
    deviation. `body_rad` are RMS turns of the body, `alone_rad` the median of what is left of the
    camera's turns without the body's, both over `LAGS_NS`. The autopilot's stamps are late by
    `offset_s` as far as turns tell.
    `turned_mount` (3, 3) is the turn of the camera on the body that would make both agree, None
    where no such turn does.
    """

    gain: Array
    sigma_gain: Array
    body_rad: Array
    alone_rad: float
    offset_s: float
    turned_mount: Array | None

    @property
    def held(self) -> bool:
        """Whether something holds the camera still about an axis about which the body turns."""
        with np.errstate(invalid="ignore"):
            return bool((self.gain + SIGMAS * self.sigma_gain < HELD_GAIN).any())

    @property
    def follows(self) -> bool:
        """Whether the camera turns with the body, in roll and in pitch, and by nothing else."""
        known = np.isfinite(self.gain)
        if not known[:2].all():
            return False
        gain, sigma = self.gain[known], self.sigma_gain[known]
        alike = (gain - sigma > FOLLOWED_GAIN) & (gain + sigma < MOST_GAIN)
        return bool(alike.all()) and not self.turns_alone

    @property
    def turns_alone(self) -> bool:
        """Whether the camera turns by more than the body and a bad clock explain."""
        body_rad = float(np.linalg.norm(self.body_rad))
        return self.alone_rad > max(float(ALONE_RAD), ALONE_SHARE * body_rad)


class FollowingTest:
    """Takes attitudes of both for some seconds, and compares their turns."""

    def __init__(self) -> None:
        self._body: deque[tuple[int, Array]] = deque()
        self._camera: deque[tuple[int, Array]] = deque()

    def add(self, sample: AttitudeSample) -> None:
        """Take the autopilot's attitude; late ones are left out."""
        if not self._body or sample.t_ns > self._body[-1][0]:
            self._body.append((sample.t_ns, np.asarray(sample.ned_from_body, np.float64)))
            while self._body[0][0] < sample.t_ns - KEPT_NS - int(OFFSETS_NS[-1]) * 2:
                self._body.popleft()

    def take(self, t_ns: int, map_from_camera: Array) -> None:
        """Take the rotation (3, 3) of a tracked frame."""
        if self._camera and t_ns - self._camera[-1][0] < SPACING_NS:
            return
        self._camera.append((t_ns, map_from_camera))
        while self._camera[0][0] < t_ns - KEPT_NS:
            self._camera.popleft()

    def forget(self) -> None:
        """Another map is in use: its turns are not comparable with those of the last."""
        self._camera.clear()

    def result(self, body_from_camera: Array) -> Following | None:
        """How turns agree by the mount (3, 3) as it is known; None while too little is known."""
        if len(self._body) < 2 or not self._camera:
            return None
        known_ns = (self._body[0][0] - int(OFFSETS_NS[0]), self._body[-1][0] - int(OFFSETS_NS[-1]))
        camera = [(t, r) for t, r in self._camera if known_ns[0] <= t <= known_ns[1]]
        if not camera or camera[-1][0] - camera[0][0] < LEAST_SPAN_NS:
            return None
        t_ns = np.array([t for t, _ in camera])
        first, second = _pairs(t_ns)
        if len(first) < 20:
            return None
        rotation = np.stack([r for _, r in camera])
        seen = vectors_from_rotations(rotation[first].transpose(0, 2, 1) @ rotation[second])
        seen = seen @ body_from_camera.T
        body_t_ns = np.array([t for t, _ in self._body])
        body_q = np.stack([q for _, q in self._body])
        at = _interpolated(body_t_ns, body_q, t_ns[None] + OFFSETS_NS[:, None])
        flown = _turns(at[:, first], at[:, second])
        left = np.median(np.linalg.norm(seen - flown, axis=2), axis=1)
        best = int(left.argmin())
        span_s = float(t_ns[-1] - t_ns[0]) * 1e-9
        return _regressed(seen, flown[best], span_s, float(OFFSETS_NS[best]) * 1e-9)


def _pairs(t_ns: Ints) -> tuple[Ints, Ints]:
    """Samples (P,) that are a lag apart, or little more."""
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
    """Unit quaternions (..., 4) at times within those of samples (S,), (S, 4), on the chord."""
    after = np.clip(np.searchsorted(t_ns, at_ns), 1, len(t_ns) - 1)
    a, b = quaternions[after - 1], quaternions[after]
    share = (at_ns - t_ns[after - 1]) / (t_ns[after] - t_ns[after - 1])
    sign = np.where((a * b).sum(-1, keepdims=True) < 0.0, -1.0, 1.0)
    mixed = a + np.clip(share, 0.0, 1.0)[..., None] * (sign * b - a)
    out: Array = mixed / np.linalg.norm(mixed, axis=-1, keepdims=True)
    return out


def _turns(a: Array, b: Array) -> Array:
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


def _regressed(seen: Array, flown: Array, span_s: float, offset_s: float) -> Following:
    n_free = max(len(LAGS_NS) * span_s / (1e-9 * LAGS_NS[-1]) / FILTERED, 1.0)
    kept = np.abs(flown) <= np.quantile(np.abs(flown), KEPT_SHARE, axis=0)
    n = kept.sum(0)
    body = np.sqrt((flown * flown * kept).sum(0) / n)
    gain = (seen * flown * kept).sum(0) / np.maximum((flown * flown * kept).sum(0), 1e-12)
    rest = np.sqrt((((seen - gain * flown) ** 2) * kept).sum(0) / n)
    sigma = rest / np.maximum(body, 1e-9) / np.sqrt(n_free)
    still = body < LEAST_TURN_RAD
    gain, sigma = np.where(still, np.nan, gain), np.where(still, np.nan, sigma)
    alone = float(np.median(np.linalg.norm(seen - flown, axis=1)))
    return Following(gain, sigma, body, alone, offset_s, _turned_mount(seen, flown))


def _turned_mount(seen: Array, flown: Array) -> Array | None:
    """The turn that takes the camera's turns to the body's (Kabsch), where one does."""
    u, size, vt = np.linalg.svd(flown.T @ seen)
    rms = np.sqrt(size / len(seen))
    if rms[1] < LEAST_TURN_RAD:
        return None  # turns about one axis tell no mount
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    rest = np.linalg.norm(seen @ turn.T - flown, axis=1)
    usual = np.linalg.norm(flown, axis=1)
    if np.median(rest) > ALONE_SHARE * np.sqrt((usual * usual).mean()):
        return None
    out: Array = turn
    return out
