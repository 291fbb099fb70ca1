"""Messages of the dense map: depth maps, fused points of keyframes, and obstacles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

from companion.messages.frame_messages import Bytes, Floats


class PixelState(Enum):
    """State of a pixel's depth filter."""

    UPDATING = 0
    CONVERGED = 1
    DIVERGED = 2
    BORDER = 3


@dataclass(frozen=True, slots=True, eq=False)
class DepthMap:
    """Dense depth of a keyframe, in its undistorted pinhole image.

    `depth` (H, W) f32 along z in map units, 0 where invalid; `sigma` (H, W) f32 likewise; `state`
    (H, W) u8 of `PixelState`; `inlier_ratio` (H, W) f32 0..1; `rgb` (H, W, 3) the undistorted
    image; `intrinsics` fx, fy, cx, cy.
    """

    keyframe_id: int
    t_ns: int
    intrinsics: tuple[float, float, float, float]
    depth: Floats
    sigma: Floats
    state: Bytes
    inlier_ratio: Floats
    rgb: Bytes
    n_updates: int
    kernel_ms: Mapping[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class PointChunk:
    """Fused points of one keyframe, in its camera frame and map units.

    `points_camera` (N, 3) f32, `rgb` (N, 3) u8, `confidence` (N,) f32 in 0..1; `normals_camera` (N,
    3) f32 unit vectors towards the camera, zero where unknown; `sigma` (N,) f32 one standard
    deviation along the line of sight, map units. A chunk moves with its keyframe and is not
    changed. `spans` are `MapUpdate.spans_of` the keyframe when the points were made, from which a
    later map gives the local scale correction.
    """

    keyframe_id: int
    t_ns: int
    points_camera: Floats
    rgb: Bytes
    confidence: Floats
    normals_camera: Floats
    sigma: Floats
    spans: Mapping[int, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class ObstaclesSeen:
    """Obstacles and free space around the vehicle, as they are told to the autopilot.

    `eye_world` (3,) is where the vehicle was at `t_ns`, the exposure of the newest image. Edges
    (N, 2, 3) lie level across the line of sight: `edges_world` at the nearest thing of a direction,
    `free_world` where a direction is free up to. What is unknown has none. f32, metres.
    """

    t_ns: int
    eye_world: Floats
    edges_world: Floats
    free_world: Floats
