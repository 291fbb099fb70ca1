"""Textured scene of planes, rendered exactly, with ground truth."""

from __future__ import annotations

import itertools

import cv2
import numpy as np

from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose
from companion.messages import Bytes, Floats
from tests.support.flights.reach import Reach


def texture(rng: np.random.Generator, size: int = 1024) -> Bytes:
    """Detail at all scales, so that every distance shows corners."""
    out = np.zeros((size, size))
    for octave in range(2, 9):
        n = 2**octave
        noise = rng.normal(size=(n, n)).astype(np.float32)
        out += cv2.resize(noise, (size, size), interpolation=cv2.INTER_CUBIC) / octave**0.5
    out = (out - out.min()) / (out.max() - out.min())
    return np.asarray(out * 255, np.uint8)


def leaves(rng: np.random.Generator, size: int = 1024) -> Bytes:
    """Leaves that fell over each other, of all sizes: sharp edges, as those of real ground.

    The dead leaves model (Lee, Mumford, Huang, 2001), of polygons; it wraps around.
    """
    out = np.full((size, size), 128, np.uint8)
    n = size * size // 40
    radii = 2.5 * rng.uniform(0.0025, 1.0, n) ** -0.5  # as many of each size as fit
    radii = np.sort(radii)[::-1]
    draws = [
        (rng.uniform(0, 2 * np.pi, 5), rng.uniform(0, size, 2), rng.normal(128, 45))
        for _ in range(n)
    ]
    angles, centres, greys = (np.array(each) for each in zip(*draws, strict=True))
    angles = np.sort(angles, axis=1)
    outlines = radii[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], 2)
    outlines += centres[:, None]
    tones = np.clip(greys, 10, 245).astype(int)
    for outline, (x, y), radius, grey in zip(
        outlines, centres.tolist(), radii.tolist(), tones.tolist(), strict=True
    ):
        for shift in itertools.product(_over(x, radius, size), _over(y, radius, size)):
            corners = (16 * (outline + shift)).astype(np.int32)
            cv2.fillPoly(out, [corners], (grey,), cv2.LINE_AA, 4)
    return out


def _over(at: float, radius: float, size: int) -> tuple[int, ...]:
    """Shifts by which what reaches over an edge comes in at the other."""
    return (0, *((size,) if at < radius else ()), *((-size,) if at > size - radius else ()))


class PlaneWorld:
    """Planes z = const in NED (down positive), each a rectangle; the highest is seen first."""

    def __init__(
        self, rng: np.random.Generator, metres_per_texel: float = 0.05,
        clear_m: float = -np.inf,
    ) -> None:  # fmt: skip
        """Draw a world, without roofs over the middle or nearer to it than `clear_m`."""
        self._metres_per_texel = metres_per_texel
        ground = np.array([-1e6, -1e6, 1e6, 1e6])
        self._planes = [(0.0, ground, texture(rng))]
        for k in range(6):
            north, east = rng.uniform(-15, 15, 2)
            size = rng.uniform(4, 8)
            rectangle = np.array([north, east, north + size, east + size])
            roof = (-1.5 - 0.5 * k, rectangle, texture(rng))
            if max(*rectangle[:2], *-rectangle[2:]) > clear_m:
                self._planes.append(roof)
        self._rays: dict[Camera, Array] = {}

    def rays_of(self, camera: Camera) -> Array:
        """Rays (H * W, 3) of its pixels, z 1; kept of each camera."""
        if camera not in self._rays:
            u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
            flat = camera.normalise(np.stack([u.ravel(), v.ravel()], 1).astype(float))
            self._rays[camera] = np.c_[flat, np.ones(len(flat))]
        return self._rays[camera]

    def render(self, camera: Camera, world_from_camera: Pose) -> tuple[Bytes, Floats]:
        """Grey image and z-depth (0: nothing) of an undistorted or distorted camera."""
        shape = (camera.height, camera.width)
        turned = self.rays_of(camera) @ world_from_camera.rotation.T
        rays = np.ascontiguousarray(turned.T).reshape(3, *shape)
        centre = world_from_camera.translation
        image, depth = np.full(shape, 128.0), np.full(shape, np.inf)
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = Reach(rays)
            for height, place, pattern in self._planes:
                part = reach.part(centre, height, place)
                if part is None:
                    continue
                to_north, to_east, to_down = rays[:, part[0], part[1]]
                n0, e0, n1, e1 = place
                z, before = (height - centre[2]) / to_down, depth[part]
                n, e = centre[0] + z * to_north, centre[1] + z * to_east
                ok = (z > 0.1) & (z < before) & (n > n0) & (n < n1) & (e > e0) & (e < e1)
                texel = np.stack([n[ok], e[ok]], 1) / self._metres_per_texel
                image[part][ok] = _sample(pattern, np.mod(texel, len(pattern) - 2))
                before[ok] = z[ok]
        depth[~np.isfinite(depth)] = 0
        return image.astype(np.uint8), depth.astype(np.float32)


def _sample(pattern: Bytes, texel: Array) -> Array:
    i = np.floor(texel).astype(int)
    f = texel - i
    i1 = i + 1
    out: Array = (
        pattern[i[:, 0], i[:, 1]] * (1 - f[:, 0]) * (1 - f[:, 1])
        + pattern[i1[:, 0], i[:, 1]] * f[:, 0] * (1 - f[:, 1])
        + pattern[i[:, 0], i1[:, 1]] * (1 - f[:, 0]) * f[:, 1]
        + pattern[i1[:, 0], i1[:, 1]] * f[:, 0] * f[:, 1]
    )
    return out


DOWN_LOOKING = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Rotation world_from_camera of a camera that looks straight down, image right to the east."""


def aligned_error(estimated: Array, truth: Array) -> tuple[float, float]:
    """RMSE after the best similarity (Umeyama 1991), and its scale truth / estimated."""
    ma, mb = estimated.mean(0), truth.mean(0)
    a, b = estimated - ma, truth - mb
    u, d, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ sign @ vt
    scale = float((d * np.diag(sign)).sum() / (a * a).sum())
    error = scale * a @ rotation.T - b
    return float(np.sqrt((error**2).sum(1).mean())), scale
