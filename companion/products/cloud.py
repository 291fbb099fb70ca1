"""Point cloud in the world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.geometry.transforms import Similarity
from companion.messages import Bytes, Floats, PointChunk


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Points (N, 3) f32 in the world, their colours (N, 3) u8 and confidences (N,) f32, 0..1.

    `normals` (N, 3) f32 are unit vectors towards where a point was seen from, zero where not known;
    `sigma` (N,) f32 is one standard deviation along the line of sight, nan where not known.
    """

    points: Floats
    rgb: Bytes
    confidence: Floats
    normals: Floats
    sigma: Floats

    def __len__(self) -> int:
        return len(self.points)

    def part(self, index: NDArray[Any] | slice) -> Cloud:
        """Subset by mask or indices."""
        return Cloud(
            self.points[index], self.rgb[index], self.confidence[index], self.normals[index],
            self.sigma[index],
        )  # fmt: skip


def no_cloud() -> Cloud:
    """A cloud without points."""
    none, none3 = np.zeros(0, np.float32), np.zeros((0, 3), np.float32)
    return Cloud(none3, np.zeros((0, 3), np.uint8), none, none3.copy(), none.copy())


def joined(clouds: Sequence[Cloud]) -> Cloud:
    """Concatenation of clouds."""
    parts = clouds or [no_cloud()]
    return Cloud(
        np.concatenate([c.points for c in parts]), np.concatenate([c.rgb for c in parts]),
        np.concatenate([c.confidence for c in parts]), np.concatenate([c.normals for c in parts]),
        np.concatenate([c.sigma for c in parts]),
    )  # fmt: skip


def placed(chunk: PointChunk, world_from_camera: Similarity) -> Cloud:
    """Points of a chunk in the world."""
    turn = world_from_camera.rotation.T.astype(np.float32)
    return Cloud(
        world_from_camera.apply(chunk.points_camera.astype(np.float64)).astype(np.float32),
        chunk.rgb, chunk.confidence, chunk.normals_camera @ turn,
        (chunk.sigma * world_from_camera.scale).astype(np.float32),
    )  # fmt: skip
