"""Messages between packages: frozen, with time, unit and frame in the names of their fields.

`t_ns` is nanoseconds on the flight's own clock: that of the computer which stamped the frames (Unix
time in recorded flights). Arrays are not to be written to after construction.
"""

from __future__ import annotations

from dataclasses import dataclass

from companion.messages.dense_messages import DepthMap, ObstaclesSeen, PixelState, PointChunk
from companion.messages.frame_messages import (
    NO_PICTURE,
    Bytes,
    Floats,
    Frame,
    FrameOverdue,
    FrameTracked,
    LandingTarget,
    Odometry,
    OpticalFlow,
    Track,
    TrackRefined,
    TrackState,
)
from companion.messages.map_messages import (
    SPANS_REACH,
    Georeference,
    Georeferenced,
    KeyframeAdded,
    LoopClosed,
    MapTakenUp,
    MapUpdate,
    SiteMapUsed,
)
from companion.telemetry import Telemetry

__all__ = [
    "NO_PICTURE", "SPANS_REACH", "Bytes", "ClockReport", "DepthMap", "Floats", "Frame",
    "FrameOverdue", "FrameTracked", "Georeference", "Georeferenced", "KeyframeAdded",
    "LandingTarget", "LoopClosed", "MapTakenUp", "MapUpdate", "Message", "ObstaclesSeen",
    "Odometry", "OpticalFlow", "PixelState", "PointChunk", "SiteMapUsed", "Track", "TrackRefined",
    "TrackState", "Warned",
]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Warned:
    """A warning for the user; `what` is a constant, by which it is counted."""

    t_ns: int
    what: str
    detail: str = ""
    good: bool = False
    """Good news: something has come, or has come back."""


@dataclass(frozen=True, slots=True, eq=False)
class ClockReport:
    """Mapping of the autopilot's boot time to the flight's clock."""

    method: str
    offset_s: float
    drift_ppm: float
    sigma_ms: float
    n_reboots: int


Message = (
    Frame | Telemetry | Track | TrackRefined | Odometry | KeyframeAdded | LoopClosed | MapUpdate
    | DepthMap | PointChunk | Warned | Georeferenced | FrameTracked | FrameOverdue | OpticalFlow
    | LandingTarget | SiteMapUsed | MapTakenUp | ObstaclesSeen
)  # fmt: skip
