"""Items of a flight to be shown. A newer item with the same key replaces the older one.

World is local NED in metres, or the map where no scale is known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np

from companion.geometry.camera import Camera
from companion.geometry.geodesy import GeoOrigin
from companion.geometry.transforms import Pose, Similarity
from companion.messages import Bytes, Floats

WHOLE, COARSE, FINE = "", "coarse", "fine"
"""Levels of a keyframe's points; coarse and fine together are all of them."""
NO_PIXELS: Floats = np.zeros((0, 2), np.float32)


class Shown(Enum):
    """Tracking state, in the pilot's words."""

    WAITING = "Waiting"
    INITIALISING = "Initialising"
    TRACKING = "Tracking"
    DEAD_RECKONING = "Dead reckoning"
    LOST = "Lost"
    STANDING = "Standing"


@dataclass(frozen=True, slots=True, eq=False)
class FlightItem:
    """Identity of the flight that all other items are of."""

    flight_id: str
    name: str
    camera: Camera
    origin: GeoOrigin | None = None
    """Geodetic origin of the world, as far as known."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseItem:
    """Pose of the camera now. Unknown values are None, quality -1."""

    t_ns: int
    shown: Shown
    world_from_camera: Pose | None = None
    n_found: int = 0
    quality: int = -1
    height_m: float | None = None
    speed_m_s: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class StatusItem:
    """Status: numbers and words by name; see companion.streaming.status_facts."""

    t_ns: int
    facts: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class LogItem:
    """A line for the log."""

    t_ns: int
    text: str
    is_warning: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class PlacesItem:
    """Poses of keyframes that have moved, in the map; None for one without a known pose.

    `world_from_map` is there when it has changed.
    """

    t_ns: int
    places: Mapping[int, Similarity | None]
    world_from_map: Similarity | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PathItem:
    """A piece of the camera's path, (N, 3) in the frame of a keyframe: it moves with it."""

    t_ns: int
    piece: int
    keyframe_id: int
    strip: Floats


@dataclass(frozen=True, slots=True, eq=False)
class AutopilotPathItem:
    """A piece of the autopilot's own path, (N, 3) in the world."""

    t_ns: int
    piece: int
    strip: Floats


@dataclass(frozen=True, slots=True, eq=False)
class PointsItem:
    """Points (N, 3) of a keyframe in its camera frame, colours (N, 3), confidence (N,) 0..1."""

    t_ns: int
    keyframe_id: int
    level: str
    points_camera: Floats
    rgb: Bytes
    confidence: Floats


@dataclass(frozen=True, slots=True, eq=False)
class SparseItem:
    """Sparse map points (N, 3) in the map."""

    t_ns: int
    points_map: Floats


@dataclass(frozen=True, slots=True, eq=False)
class ImageItem:
    """A frame (H, W, 3), and the points found in it, (N, 2) pixels."""

    t_ns: int
    rgb: Bytes
    found_px: Floats = field(default_factory=lambda: NO_PIXELS)


@dataclass(frozen=True, slots=True, eq=False)
class PictureItem:
    """The same as JPEG; `found_px` (N, 2) are pixels of the picture as it is, of this width."""

    t_ns: int
    jpeg: bytes
    width: int
    found_px: Floats


@dataclass(frozen=True, slots=True, eq=False)
class DepthItem:
    """Depth of the newest keyframe as a picture, near is red; and the times of its kernels."""

    t_ns: int
    image: bytes
    media_type: str
    kernel_ms: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class ObstaclesItem:
    """Obstacles and free space now: edges (N, 2, 3) in the world, and from where (3,)."""

    t_ns: int
    eye_world: Floats
    edges_world: Floats
    free_world: Floats


Item = (
    FlightItem | PoseItem | StatusItem | LogItem | PlacesItem | PathItem | AutopilotPathItem
    | PointsItem | SparseItem | ImageItem | PictureItem | DepthItem | ObstaclesItem
)  # fmt: skip
