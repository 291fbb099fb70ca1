"""Camera models: projection and its inverse. numpy only, pure.

Rays are `normalised` image coordinates (x/z, y/z), so that solvers are independent of the lens.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.geometry.gimbal import Gimbal
from companion.geometry.transforms import Array, Pose

MAX_OFF_AXIS_RAD = np.radians(80.0)
"""Larger angles from the optical axis have no usable normalised coordinates."""
CONVERGED = 1e-12
"""Convergence threshold, in normalised coordinates."""


class Distortion(Enum):
    """Lens distortion models."""

    NONE = "none"
    RADTAN = "radtan"
    """Brown-Conrady, coefficients k1 k2 p1 p2 k3."""
    EQUIDISTANT = "equidistant"
    """Kannala-Brandt fisheye, coefficients k1 k2 k3 k4."""


LENS = ("width", "height", "fx", "fy", "cx", "cy")
COEFFICIENTS: dict[Distortion, tuple[str, ...]] = {
    Distortion.NONE: (),
    Distortion.RADTAN: ("k1", "k2", "p1", "p2", "k3"),
    Distortion.EQUIDISTANT: ("k1", "k2", "k3", "k4"),
}
"""Names of the coefficients of each model, in their order."""


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """Intrinsics and mount of a camera.

    `coefficients` has the length that the model requires. `body_from_camera` is None when unknown
    (hand-held): attitude then does not apply to the camera. On a `gimbal` it is how the camera sits
    in the gimbal's head.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Distortion = Distortion.NONE
    coefficients: tuple[float, ...] = ()
    body_from_camera: Pose | None = None
    assumed: bool = field(default=False)
    """True if the intrinsics are a guess, without calibration."""
    readout_ms: float | None = None
    """Time from the exposure of the top row to that of the bottom one; 0 for a global shutter, None
    where unknown."""
    gimbal: Gimbal | None = None
    """None of a camera that is fixed to the body."""

    @property
    def lens(self) -> dict[str, float]:
        """Size, focal lengths and centre by name, as documents have them."""
        return {name: getattr(self, name) for name in LENS}

    def sees_as(self, other: Camera) -> bool:
        """True if directions have the same pixels in both."""
        model = (self.distortion, self.coefficients) == (other.distortion, other.coefficients)
        return model and self.lens == other.lens

    @property
    def focal_px(self) -> float:
        """Mean focal length in pixels."""
        return 0.5 * (self.fx + self.fy)

    @property
    def camera_from_body(self) -> Pose:
        """Inverse mount; the identity where unknown."""
        mount = self.body_from_camera
        return mount.inverse() if mount is not None else Pose.identity()

    def matrix(self) -> Array:
        """The (3, 3) intrinsic matrix."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def pinhole(self) -> Camera:
        """The same camera without distortion."""
        return Camera(
            self.width, self.height, self.fx, self.fy, self.cx, self.cy,
            body_from_camera=self.body_from_camera, assumed=self.assumed, gimbal=self.gimbal,
        )  # fmt: skip

    def distort(self, normalised: Array) -> Array:
        """Distorted normalised coordinates (N, 2) of ideal ones (N, 2)."""
        n = np.asarray(normalised, np.float64)
        if self.distortion is Distortion.NONE:
            return n
        x, y = n[..., 0], n[..., 1]
        r2 = x * x + y * y
        if self.distortion is Distortion.RADTAN:
            k1, k2, p1, p2, k3 = self.coefficients
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            return np.stack(
                [
                    x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                    y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
                ],
                -1,
            )
        k1, k2, k3, k4 = self.coefficients
        r = np.sqrt(r2)
        theta = np.arctan(r)
        t2 = theta * theta
        theta_d = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
        scale = np.where(r > 1e-9, theta_d / np.maximum(r, 1e-9), 1.0)
        out: Array = n * scale[..., None]
        return out

    def project(self, points_camera: Array) -> Array:
        """Pixels (N, 2) of points (N, 3) in the camera frame; nan where z <= 0."""
        p = np.asarray(points_camera, np.float64)
        z = np.where(p[..., 2] > 0, p[..., 2], np.nan)
        d = self.distort(p[..., :2] / z[..., None])
        return np.stack([self.fx * d[..., 0] + self.cx, self.fy * d[..., 1] + self.cy], -1)

    def normalise(self, pixels: NDArray[Any]) -> Array:
        """Ideal normalised coordinates (N, 2) of distorted pixels (N, 2); nan where undefined."""
        px = np.asarray(pixels, np.float64)
        d = np.stack([(px[..., 0] - self.cx) / self.fx, (px[..., 1] - self.cy) / self.fy], -1)
        if self.distortion is Distortion.NONE:
            return d
        if self.distortion is Distortion.EQUIDISTANT:
            return self._undistort_equidistant(d)
        n = d.copy()
        for _ in range(8):  # Newton on the 2-D model: converges also where plain iteration does not
            error = self.distort(n) - d
            if np.abs(error).max(initial=0.0, where=np.isfinite(error)) < CONVERGED:
                break
            j = self._distortion_jacobian(n)
            (a, b), (c, e) = (j[..., 0, 0], j[..., 0, 1]), (j[..., 1, 0], j[..., 1, 1])
            x, y = error[..., 0], error[..., 1]
            n = n - np.stack([e * x - b * y, a * y - c * x], -1) / (a * e - b * c)[..., None]
        return np.where(np.abs(self.distort(n) - d).max(-1, keepdims=True) < 1e-6, n, np.nan)

    def pixel_from_normalised_jacobian(self, normalised: Array) -> Array:
        """Derivative (N, 2, 2) of the distorted pixel by ideal normalised coordinates."""
        j = self._distortion_jacobian(np.asarray(normalised, np.float64))
        out: Array = j * np.array([[self.fx], [self.fy]])
        return out

    def _undistort_equidistant(self, distorted: Array) -> Array:
        k1, k2, k3, k4 = self.coefficients
        theta_d = np.linalg.norm(distorted, axis=-1)
        theta = theta_d.copy()
        for _ in range(10):
            t2 = theta * theta
            f = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) - theta_d
            df = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
            theta = theta - f / np.where(np.abs(df) > 1e-6, df, 1e-6)
        good = (theta < MAX_OFF_AXIS_RAD) & (theta >= 0)
        scale = np.where(
            theta_d > 1e-9, np.tan(np.where(good, theta, 0)) / np.maximum(theta_d, 1e-9), 1.0
        )
        return np.where(good[..., None], distorted * scale[..., None], np.nan)

    def _distortion_jacobian(self, n: Array) -> Array:
        if self.distortion is Distortion.NONE:
            return np.broadcast_to(np.eye(2), (*n.shape[:-1], 2, 2))
        if self.distortion is Distortion.RADTAN:
            x, y = n[..., 0], n[..., 1]
            k1, k2, p1, p2, k3 = self.coefficients
            r2 = x * x + y * y
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))
            cross = slope * x * y + 2 * (p1 * x + p2 * y)
            out = np.empty((*n.shape[:-1], 2, 2))
            out[..., 0, 0] = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
            out[..., 0, 1] = out[..., 1, 0] = cross
            out[..., 1, 1] = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
            return out
        step = 1e-6
        dx = (self.distort(n + [step, 0]) - self.distort(n - [step, 0])) / (2 * step)
        dy = (self.distort(n + [0, step]) - self.distort(n - [0, step])) / (2 * step)
        return np.stack([dx, dy], -1)
