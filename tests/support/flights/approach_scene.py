"""Walls, poles and branches, textured, rendered exactly, with true depth and distances."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose
from companion.messages import Bytes, Floats
from tests.support.flights.scene import leaves

NOTHING = np.float32(1e4)
SKY = 200
SAMPLES = 2
"""Rays along each side of a pixel."""
Met = tuple[NDArray[np.intp], Array | Floats, Array, Array, Array | Floats]
"""Numbers of the rays that meet a thing, and of these what `_met` says, the cosine of rays as long
as they are."""


@dataclass(frozen=True, slots=True, eq=False)
class Sheet:
    """A rectangle: a corner (3,), two sides (3,), metres NED."""

    corner: Array
    side_a: Array
    side_b: Array
    look: int


@dataclass(frozen=True, slots=True, eq=False)
class Rod:
    """A round rod: its ends (3,), NED metres, and radius."""

    begin: Array
    end: Array
    radius_m: float
    look: int


class ApproachScene:
    """Things before a camera; a pixel that meets none is sky.

    Drawn without aliasing: each pixel is the mean of `SAMPLES` x `SAMPLES` rays, and each ray takes
    its grey from the texture as coarse as what it covers of it.
    """

    def __init__(self, things: list[Sheet | Rod], metres_per_texel: float = 0.02) -> None:
        self.things = things
        self._metres_per_texel = metres_per_texel
        looks = {each.look for each in things}
        self._patterns = {
            look: _coarser(leaves(np.random.default_rng(look), 512)) for look in looks
        }
        self._rays: dict[tuple[int, int], Floats] = {}

    def picture(self, camera: Camera, ned_from_camera: Pose) -> Bytes:
        """Grey image (H, W)."""
        rays = self._rays_of(camera, SAMPLES) @ ned_from_camera.rotation.T.astype(np.float32)
        nearest, a, b, width_m = self._met(rays, ned_from_camera.translation)
        width_m *= 1.0 / (SAMPLES * camera.fx)
        image = np.full(len(rays), SKY, np.float32)
        for n, thing in enumerate(self.things):
            hit = np.flatnonzero(nearest == n)
            at = [(v[hit] / self._metres_per_texel).astype(np.float32) for v in (a, b)]
            texels = width_m[hit] / self._metres_per_texel
            image[hit] = _drawn(self._patterns[thing.look], at[0], at[1], texels)
        shape = camera.height, SAMPLES, camera.width, SAMPLES
        return np.asarray(np.rint(image.reshape(shape).mean((1, 3))), np.uint8)

    def depth(self, camera: Camera, ned_from_camera: Pose) -> Floats:
        """True z-depth (H, W) at the centres of pixels, 0 where sky."""
        rays = self._rays_of(camera, 1) @ ned_from_camera.rotation.T.astype(np.float32)
        depth = np.zeros(len(rays), np.float32)
        eye = ned_from_camera.translation
        away = np.min([_met(thing, rays, eye)[0] for thing in self.things], axis=0)
        depth[away < NOTHING] = away[away < NOTHING]
        return depth.reshape(camera.height, camera.width)

    def _met(self, rays: Floats, eye: Array) -> tuple[Array, Floats, Floats, Floats]:
        """Of rays (N, 3): index of what each meets, -1 for none, the place on it, metres, and how
        wide a ray of one radian's width is there."""
        depth, nearest = np.full(len(rays), NOTHING), np.full(len(rays), -1)
        a, b, width_m = (np.zeros(len(rays), np.float32) for _ in range(3))
        for n, thing in enumerate(self.things):
            away, a_here, b_here, cosine = _met(thing, rays, eye)
            hit = (away > 0.1) & (away < depth)
            depth[hit], nearest[hit], a[hit], b[hit] = away[hit], n, a_here[hit], b_here[hit]
            width_m[hit] = away[hit] / np.maximum(cosine[hit], 1e-3)
        return nearest, a, b, width_m

    def _rays_of(self, camera: Camera, samples: int) -> Floats:
        key = id(camera), samples
        if key not in self._rays:
            u, v = (
                (np.arange(samples * n) + 0.5) / samples - 0.5
                for n in (camera.width, camera.height)
            )
            flat = camera.normalise(np.stack(np.meshgrid(u, v), -1).reshape(-1, 2))
            self._rays[key] = np.c_[flat, np.ones(len(flat))].astype(np.float32)
        return self._rays[key]

    def nearest_m(self, place: Array, bearings_rad: Array, above_m: float, below_m: float) -> Array:
        """True horizontal distance (N,) of what stands in a band of heights about a place."""
        out = np.full(len(bearings_rad), np.inf)
        for down in np.linspace(-above_m, below_m, 15):
            eye = place + [0.0, 0.0, down]
            rays = np.c_[np.cos(bearings_rad), np.sin(bearings_rad), np.zeros(len(bearings_rad))]
            for thing in self.things:
                away = _met(thing, rays.astype(np.float32), eye)[0]
                out = np.where(away > 0.1, np.minimum(out, away), out)
        return out


def _coarser(pattern: Bytes) -> list[Bytes]:
    """A pattern that repeats, and the same at half the resolution, again and again."""
    levels = [pattern]
    while len(levels[-1]) > 1:
        half = len(levels[-1]) // 2
        smaller = cv2.resize(levels[-1], (half, half), interpolation=cv2.INTER_AREA)
        levels.append(np.asarray(smaller, np.uint8))
    return levels


def _drawn(levels: list[Bytes], column: Floats, row: Floats, texels: Floats) -> Floats:
    """Grey (N,) of a pattern at places (N,), where each ray covers so many texels (N,)."""
    fine = np.clip(np.log2(np.maximum(texels, 1e-6)), 0.0, len(levels) - 1.0)
    grey = np.zeros(len(column), np.float32)
    for k, pattern in enumerate(levels):
        weight = 1.0 - np.abs(fine - k)
        here = np.flatnonzero(weight > 0)
        for at in np.array_split(here, -(-len(here) // 30000) or 1):  # remap takes no longer rows
            if len(at) == 0:
                continue
            u, v = (
                np.mod((x[at] + 0.5) / 2**k - 0.5, len(pattern)).astype(np.float32)
                for x in (column, row)
            )
            grey[at] += (
                weight[at]
                * cv2.remap(
                    pattern, u[None], v[None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
                ).ravel()
            )
    return grey


def _met(thing: Sheet | Rod, rays: Floats, eye: Array) -> tuple[Floats, Floats, Floats, Floats]:
    """Lengths of rays (N, 3) up to it, `NOTHING` without, places on it, metres, and the cosines of
    the angles at which they meet it, of unit rays."""
    with np.errstate(divide="ignore", invalid="ignore"):
        if isinstance(thing, Sheet):
            met, away, a, b, cosine = _sheet_met(thing, rays, eye)
        else:
            met, away, a, b, cosine = _rod_met(thing, rays, eye)
    whole = [np.full(len(rays), none, np.float32) for none in (NOTHING, 0.0, 0.0, 1.0)]
    found = away, a, b, cosine / np.linalg.norm(rays[met], axis=1)
    for each, part in zip(whole, found, strict=True):
        each[met] = part
    return whole[0], whole[1], whole[2], whole[3]


def _sheet_met(sheet: Sheet, rays: Floats, eye: Array) -> Met:
    normal = np.cross(sheet.side_a, sheet.side_b)
    away: Floats = np.float32((sheet.corner - eye) @ normal) / (rays @ normal.astype(np.float32))
    at = eye + away[:, None] * rays - sheet.corner
    lengths = [float(np.linalg.norm(side)) for side in (sheet.side_a, sheet.side_b)]
    a, b = (at @ (s / n) for s, n in zip((sheet.side_a, sheet.side_b), lengths, strict=True))
    cosine = np.abs(rays @ (normal / np.linalg.norm(normal)).astype(np.float32))
    met = np.flatnonzero(
        (a >= 0) & (a <= lengths[0]) & (b >= 0) & (b <= lengths[1]) & (away > 0)
    )  # fmt: skip
    return met, away[met], a[met], b[met], cosine[met]


def _rod_met(rod: Rod, rays: Floats, eye: Array) -> Met:
    """All but a ray's distance from it is of those alone that pass near it."""
    length = float(np.linalg.norm(rod.end - rod.begin))
    axis = (rod.end - rod.begin) / length
    across, start = rays - np.outer(rays @ axis, axis), eye - rod.begin
    start = start - (start @ axis) * axis
    aa, ab = np.einsum("ni,ni->n", across, across), across @ start
    root = ab**2 - aa * (start @ start - rod.radius_m**2)
    near = np.flatnonzero(root > 0)
    rays = rays[near]
    away = (-ab[near] - np.sqrt(root[near])) / aa[near]
    at = eye + away[:, None] * rays - rod.begin
    b = at @ axis
    side = at - b[:, None] * axis
    first = np.cross(axis, [0.3, 0.5, 0.81])
    first /= np.linalg.norm(first)
    a = rod.radius_m * np.arctan2(side @ np.cross(axis, first), side @ first)
    cosine = np.abs((side * rays).sum(1)) / rod.radius_m
    met = np.flatnonzero((b >= 0) & (b <= length) & (away > 0))
    return near[met], away[met], a[met], b[met], cosine[met]
