"""Walls, poles and branches, textured, rendered exactly, with true depth and distances."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose
from companion.messages import Bytes, Floats
from tests.support.flights.scene import leaves

NOTHING = np.float32(1e4)


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
    """Things before a camera; a pixel that meets none is sky."""

    def __init__(self, things: list[Sheet | Rod], metres_per_texel: float = 0.02) -> None:
        self.things = things
        self._metres_per_texel = metres_per_texel
        looks = {each.look for each in things}
        self._patterns = {look: leaves(np.random.default_rng(look), 512) for look in looks}
        self._rays: dict[int, Floats] = {}

    def picture(self, camera: Camera, ned_from_camera: Pose) -> Bytes:
        """Grey image (H, W)."""
        return self.render(camera, ned_from_camera)[0]

    def render(self, camera: Camera, ned_from_camera: Pose) -> tuple[Bytes, Floats]:
        """Grey image and z-depth (H, W), 0 where sky."""
        if id(camera) not in self._rays:
            u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
            flat = camera.normalise(np.stack([u, v], -1).reshape(-1, 2))
            self._rays[id(camera)] = np.c_[flat, np.ones(len(flat))].astype(np.float32)
        rays = self._rays[id(camera)] @ ned_from_camera.rotation.T.astype(np.float32)
        eye = ned_from_camera.translation
        depth = np.full(len(rays), NOTHING)
        image = np.full(len(rays), 200, np.uint8)
        for thing in self.things:
            away, a, b = _met(thing, rays, eye)
            hit = (away > 0.1) & (away < depth)
            if not hit.any():
                continue
            pattern = self._patterns[thing.look]
            column, row = (
                np.mod(v[hit] / self._metres_per_texel, len(pattern)).astype(np.float32)
                for v in (a, b)
            )
            drawn = (
                cv2.remap(
                    pattern, column[None], row[None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
                )
                if hit.sum() < 32000
                else _in_parts(pattern, column, row)
            )
            image[hit], depth[hit] = drawn.ravel(), away[hit]
        depth[depth >= NOTHING] = 0
        shape = camera.height, camera.width
        return image.reshape(shape), depth.reshape(shape)

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


def _in_parts(pattern: Bytes, column: Floats, row: Floats) -> Bytes:
    """`cv2.remap` takes no row of more than 32767 pixels."""
    return np.concatenate([
        cv2.remap(
            pattern, column[None, at : at + 30000], row[None, at : at + 30000], cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_WRAP,
        ).ravel()
        for at in range(0, len(column), 30000)
    ])  # fmt: skip


def _met(thing: Sheet | Rod, rays: Floats, eye: Array) -> tuple[Floats, Floats, Floats]:
    """Lengths of rays (N, 3) up to it, `NOTHING` without, and places on it, metres."""
    with np.errstate(divide="ignore", invalid="ignore"):
        if isinstance(thing, Sheet):
            normal = np.cross(thing.side_a, thing.side_b)
            away = np.float32((thing.corner - eye) @ normal) / (rays @ normal.astype(np.float32))
            at = eye + away[:, None] * rays - thing.corner
            lengths = [float(np.linalg.norm(side)) for side in (thing.side_a, thing.side_b)]
            a, b = (
                at @ (s / n) for s, n in zip((thing.side_a, thing.side_b), lengths, strict=True)
            )
            met = (a >= 0) & (a <= lengths[0]) & (b >= 0) & (b <= lengths[1]) & (away > 0)
        else:
            length = float(np.linalg.norm(thing.end - thing.begin))
            axis = (thing.end - thing.begin) / length
            across, start = rays - np.outer(rays @ axis, axis), eye - thing.begin
            start = start - (start @ axis) * axis
            aa, ab = (across**2).sum(1), across @ start
            root = ab**2 - aa * (start @ start - thing.radius_m**2)
            away = (-ab - np.sqrt(root)) / aa
            at = eye + away[:, None] * rays - thing.begin
            b = at @ axis
            side = at - b[:, None] * axis
            first = np.cross(axis, [0.3, 0.5, 0.81])
            first /= np.linalg.norm(first)
            a = thing.radius_m * np.arctan2(side @ np.cross(axis, first), side @ first)
            met = (root > 0) & (b >= 0) & (b <= length) & (away > 0)
    return (
        np.where(met, away, NOTHING).astype(np.float32),
        np.where(met, a, 0).astype(np.float32), np.where(met, b, 0).astype(np.float32),
    )  # fmt: skip
