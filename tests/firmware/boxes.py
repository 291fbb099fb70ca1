"""Boxes of the drawn scene: containers, huts and walls, placed by a seed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.geometry.transforms import Array

N_BOXES = 10
FREE_M = 10.0
"""Half side of the square that stays free: 6 m about a pad whose half side is 4 m."""
FARTHEST_M = 34.0
APART_M = 1.0
BOX_MAX_M = 4.0
"""Above 5 m one may fly anywhere."""
SHADES = (0.62, 0.8, 0.95, 0.72)
"""Of walls to the south, east, north and west, which one light falls upon."""
ROOF_SHADE = 1.15


@dataclass(frozen=True, slots=True)
class Box:
    """A box on the ground: its middle, half sizes and height, metres."""

    north: float
    east: float
    half_north: float
    half_east: float
    height: float

    def corners(self) -> Array:
        """The four on the ground (4, 2): south-west, south-east, north-east, north-west."""
        signs = np.array([(-1, -1), (-1, 1), (1, 1), (1, -1)])
        half = np.array([self.half_north, self.half_east])
        return np.asarray([self.north, self.east] + signs * half, np.float64)


def boxes_of(seed: int) -> list[Box]:
    """Boxes around the free square that do not touch each other."""
    rng = np.random.default_rng(seed + 2)
    found: list[Box] = []
    while len(found) < N_BOXES:
        half_north, half_east = rng.uniform(0.8, 3.5, 2)
        north, east = rng.uniform(-FARTHEST_M, FARTHEST_M, 2)
        if len(found) < N_BOXES // 2:  # half of them near: they are what stands out
            north, east = 0.6 * north, 0.6 * east
        box = Box(north, east, half_north, half_east, rng.uniform(1.2, BOX_MAX_M))
        if max(abs(north) - half_north, abs(east) - half_east) < FREE_M:
            continue
        if all(_apart(box, other) for other in found):
            found.append(box)
    return found


def triangles_of(boxes: list[Box], seed: int) -> Array:
    """Vertices (N, 9): place, metres on the face's texture, tint RGB, 0 for "no ground"."""
    rng = np.random.default_rng(seed + 3)
    rows: list[Array] = [np.zeros((0, 9))]
    for box in boxes:
        tint = rng.uniform(0.6, 1.0) * rng.normal(1.0, 0.12, 3)
        low = np.c_[box.corners(), np.zeros(4)]
        high = low - [0.0, 0.0, box.height]
        rows.append(_face(rng, high, tint * ROOF_SHADE))
        for k, shade in enumerate(SHADES):
            after = (k + 1) % 4
            face = np.stack([low[k], low[after], high[after], high[k]])
            rows.append(_face(rng, face, tint * shade))
    return np.concatenate(rows)


def _apart(a: Box, b: Box) -> bool:
    north = abs(a.north - b.north) - a.half_north - b.half_north
    east = abs(a.east - b.east) - a.half_east - b.half_east
    return max(north, east) > APART_M


def _face(rng: np.random.Generator, corners: Array, tint: Array) -> Array:
    """Two triangles of a rectangle (4, 3), with a piece of the ground's texture of its own."""
    along = np.linalg.norm(corners[1] - corners[0])
    up = np.linalg.norm(corners[3] - corners[0])
    metres = rng.uniform(-50, 50, 2) + np.array([(0, 0), (along, 0), (along, up), (0, up)])
    rows = np.c_[corners, metres, np.tile(tint, (4, 1)), np.zeros(4)]
    return np.asarray(rows[[0, 1, 2, 0, 2, 3]], np.float64)
