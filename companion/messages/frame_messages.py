"""Messages about frames: images, their tracks, and what goes to the autopilot of each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from companion.geometry.transforms import Array, Pose

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image. `t_ns` is mid-exposure; `grey` (H, W) u8; `rgb` (H, W, 3) u8."""

    seq: int
    t_ns: int
    grey: Bytes
    rgb: Bytes


NO_PICTURE = 1 << 31
"""Numbers from here on are those of notices, not of frames."""


@dataclass(frozen=True, slots=True)
class FrameOverdue:
    """Notice of a frame that was due at `t_ns` and did not come; `seq` is above NO_PICTURE."""

    seq: int
    t_ns: int


class TrackState(Enum):
    """State of the tracker."""

    INITIALISING = "initialising"
    TRACKING = "tracking"
    DEAD_RECKONING = "dead reckoning"
    """No map points found; the pose is propagated by the autopilot's attitude and velocity."""
    LOST = "lost"
    STANDING = "standing"
    """Of an odometry only: the vehicle stands on the ground, at a fixed place."""

    @classmethod
    def _missing_(cls, value: object) -> TrackState | None:
        """Dead reckoning under its name in earlier recordings."""
        return cls.DEAD_RECKONING if value == "coasting" else None


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Pose of one frame, or none.

    `map_from_camera` is the pose as estimated at that time, `keyframe_from_camera` that relative to
    keyframe `keyframe_id`, which stays valid when the map is corrected. All are None unless
    tracking. `keypoints_px` (N, 2) are distorted pixels of the map points found. `backfilled` marks
    frames that were localised afterwards (those between the two initial keyframes, say). The sigmas
    are of the pose in the map by this image alone, the position's in map units.
    """

    seq: int
    t_ns: int
    state: TrackState
    map_from_camera: Pose | None = None
    keyframe_id: int | None = None
    keyframe_from_camera: Pose | None = None
    n_inliers: int = 0
    n_matches: int = 0
    keypoints_px: Floats | None = None
    backfilled: bool = False
    sigma_position: float = float("inf")
    sigma_rotation_rad: float = float("inf")
    shutter_motion: Array | None = None
    """Motion (3, 3) by which the rolling shutter of the image was undone, as of
    `companion.geometry.rolling_shutter.shutter_motion`."""


@dataclass(frozen=True, slots=True, eq=False)
class TrackRefined:
    """Pose of an earlier frame, in place of that of its Track: its points have been adjusted since.

    `keyframe_from_camera` is relative to keyframe `keyframe_id`, as in Track.
    """

    seq: int
    t_ns: int
    keyframe_id: int
    keyframe_from_camera: Pose


@dataclass(frozen=True, slots=True, eq=False)
class Odometry:
    """Pose of the body for an autopilot: metric, level, and without jumps.

    `world_from_body` is in local NED metres, or, where no position gives its origin, in metres from
    where the map began. It follows the camera smoothly: later corrections of the map are applied
    with limited slew, and only a discontinuity, which raises `reset_counter`, moves it at once.
    None while lost or without a metric scale. `velocity_world_m_s` (3,); `sigma_position_m` is one
    standard deviation, along each axis, of the way of the last ten seconds, about as far back as an
    autopilot's filter remembers; by dead reckoning of the place since the last one that was seen,
    too. `sigma_attitude_rad` is that of the tilt about each level axis, infinite where nobody says
    how the camera sits on the body: then pose and velocity are the camera's,
    `sigma_yaw_rad` of the heading, against north; `quality` is 1..100, or -1 while the pose is
    unknown.
    """

    seq: int
    t_ns: int
    state: TrackState
    reset_counter: int
    quality: int = -1
    world_from_body: Pose | None = None
    velocity_world_m_s: Array | None = None
    sigma_position_m: float = float("inf")
    sigma_velocity_m_s: float = float("inf")
    sigma_attitude_rad: float = float("inf")
    sigma_yaw_rad: float = float("inf")
    inertial: bool = False
    """Dead reckoning goes by accelerometers."""
    sigma_scale: float = 0.0
    """Relative standard deviation of the scale, by which all distances are wrong alike."""
    sigma_by_scale_m: float = 0.0
    """Part of `sigma_position_m` that comes of it."""
    unaided_s: float = 0.0
    """Time for which dead reckoning has gone by accelerometers alone, the autopilot's own."""
    refused: Mapping[str, int] = field(default_factory=dict)
    """Number of measurements that did not fit the body's motion, so far, by kind."""


@dataclass(frozen=True, slots=True, eq=False)
class OpticalFlow:
    """Flow of the ground from the frame before to this one, as a sensor that looks down sees it.

    `flow_rad_s` (2,) is the angular rate of the ground below about the body's x and y axes by
    translation alone: with the velocity v of the camera in body axes and the distance r of the
    ground along the body's down axis it is (-v_y / r, v_x / r), so that flying forward gives
    positive y and flying to the right negative x. None where it could not be measured, because of
    `why_not`. `turn_rad` (3,) is the body's rotation vector in the interval of `dt_s` up to `t_ns`,
    in body axes. A sensor without gyroscopes sees the sum of both.
    """

    seq: int
    t_ns: int
    dt_s: float
    flow_rad_s: Array | None = None
    turn_rad: Array | None = None
    sigma_rad_s: float = float("inf")
    """Standard deviation of the flow about each axis by the image alone."""
    quality: int = 0
    """0..255; 0: none."""
    distance_m: float | None = None
    """Distance of the ground along the body's down axis; None where unknown."""
    why_not: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class LandingTarget:
    """The landing marker in one image, or why there is none.

    `position_body_m` (3,) is its centre from the origin of the body, FRD; `sigma_body_m` (3,) one
    standard deviation along each axis. `normals_body` (N, 3) are unit vectors out of its face, of
    each pose that the image allows: two, where it is small (Schweighofer and Pinz 2006). `size_px`
    is its mean edge. All but `why_not` are empty where there is none.
    """

    seq: int
    t_ns: int
    position_body_m: Array | None = None
    sigma_body_m: Array | None = None
    normals_body: Array | None = None
    size_px: float = 0.0
    why_not: str = ""


@dataclass(frozen=True, slots=True)
class FrameTracked:
    """Inputs beside the image that the pose of a frame depends on; given before it.

    `n_samples` of telemetry had been taken since the beginning. `mapping_point` is where mapping
    stood, see `companion.slam.mapping.mapping_worker.MapLock`; `feature_ratio` the load level.
    `has_picture` is False of a FrameOverdue. `origin` is that of local NED in latitude, longitude
    (degrees) and altitude (m), where it was told since the frame before and a site map is in use.
    """

    t_ns: int
    seq: int
    n_samples: int
    mapping_point: int
    feature_ratio: float
    has_picture: bool = True
    origin: tuple[float, float, float] | None = None
