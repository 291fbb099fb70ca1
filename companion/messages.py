"""Messages between packages: frozen, with time, unit and frame in the names of their fields.

`t_ns` is nanoseconds on the flight's own clock: that of the computer which stamped the frames (Unix
time in recorded flights). Arrays are not to be written to after construction.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from companion.geometry.transforms import Array, Pose, Similarity
from companion.telemetry import Telemetry

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
    DEAD_RECKONING = "coasting"
    """No map points found; the pose is propagated by the autopilot's attitude and velocity."""
    LOST = "lost"
    STANDING = "standing"
    """Of an odometry only: the vehicle stands on the ground, at a fixed place."""


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
class Odometry:
    """Pose of the body for an autopilot: metric, level, and without jumps.

    `world_from_body` is in local NED metres, or, where no position gives its origin, in metres from
    where the map began. It follows the camera smoothly: later corrections of the map are applied
    with limited slew, and only a discontinuity, which raises `reset_counter`, moves it at once.
    None while lost or without a metric scale. `velocity_world_m_s` (3,); `sigma_position_m` is one
    standard deviation, along each axis, of the way of the last ten seconds, about as far back as an
    autopilot's filter remembers; by dead reckoning of the place since the last one that was seen,
    too. `sigma_attitude_rad` is that of the tilt about each level axis,
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
    """Inputs beside the image that the pose of a frame depended on; given after it.

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


@dataclass(frozen=True, slots=True)
class SiteMapUsed:
    """The map of an earlier flight that this one uses: its file, revision and BLAKE2b digest."""

    t_ns: int
    path: str
    revision: int
    digest: str


@dataclass(frozen=True, slots=True, eq=False)
class MapTakenUp:
    """The map of a process before, looked for from the frame at `t_ns` on.

    `data` (N,) are the bytes of its checkpoint, whose last frame was `absent_ns` ago.
    """

    t_ns: int
    absent_ns: int
    data: Bytes


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeAdded:
    """A new keyframe: its frame, and the map points that it sees.

    `points_camera` (N, 3) are these points in its camera frame, map units.
    """

    keyframe_id: int
    seq: int
    t_ns: int
    map_from_camera: Pose
    points_camera: Array


@dataclass(frozen=True, slots=True)
class LoopClosed:
    """A loop closure or map merge: keyframe `keyframe_id` observes what `other_id` did before.

    Within the same map a loop closed, which moved the newer end by `moved` map units; else two maps
    were merged, the other's unit being `scale` of this one's.
    """

    t_ns: int
    keyframe_id: int
    other_id: int
    same_map: bool
    moved: float
    scale: float


@dataclass(frozen=True, slots=True, eq=False)
class Georeference:
    """Transform of the map to the world: local NED in metres.

    `metres_per_unit` is `world_from_map.scale`; the sigmas are one standard deviation. `method` is
    the source of the scale in words.
    """

    world_from_map: Similarity
    sigma_scale: float
    """Standard deviation relative to the scale: 0.01 is one percent."""
    sigma_yaw_rad: float
    method: str
    n_positions: int
    residual_m: float
    has_origin: bool = True
    """False where only the scale is known: the world then begins at the first camera."""


@dataclass(frozen=True, slots=True, eq=False)
class Georeferenced:
    """Georeference of the newest map, without its keyframes and points."""

    t_ns: int
    georeference: Georeference | None


SPANS_REACH = 6
"""Number of keyframes before and after one whose distances give its local scale correction."""


@dataclass(frozen=True, slots=True, eq=False)
class MapUpdate:
    """The map now: every keyframe's pose, and the sparse points (N, 3) in map units.

    `scale_of` holds, for keyframes of segments with a scale of their own, the number of map units
    in one unit of the keyframe's camera frame; all others are 1. A keyframe that is missing here
    has no known pose, and neither has what is attached to it. `n_retired` redundant keyframes have
    left the map and move with their neighbours.
    """

    revision: int
    t_ns: int
    map_from_camera: Mapping[int, Pose]
    points_map: Array
    georeference: Georeference | None
    scale_of: Mapping[int, float] = field(default_factory=dict)
    n_retired: int = 0

    @property
    def n_keyframes(self) -> int:
        """Keyframes in the map."""
        return len(self.map_from_camera) - self.n_retired

    def place_of(self, keyframe_id: int) -> Similarity | None:
        """Transform `map_from_camera` of a keyframe, scale included; None if unknown."""
        pose = self.map_from_camera.get(keyframe_id)
        if pose is None:
            return None
        return Similarity(self.scale_of.get(keyframe_id, 1.0), pose.rotation, pose.translation)

    def spans_of(self, keyframe_id: int) -> dict[int, float]:
        """Distances of neighbouring keyframes from one, in the unit of its camera frame."""
        place = self.place_of(keyframe_id)
        if place is None:
            return {}
        around = range(keyframe_id - SPANS_REACH, keyframe_id + SPANS_REACH + 1)
        others = [k for k in around if k != keyframe_id and self._with(place, k)]
        return {k: self._span(place, k) for k in others}

    def local_scale_of(self, keyframe_id: int, spans: Mapping[int, float]) -> float:
        """Local scale correction of measurements made about a keyframe when it had these spans.

        The median of the ratios of spans, weighted by length; 1 without any.
        """
        place = self.place_of(keyframe_id)
        if place is None:
            return 1.0
        ratios = sorted(
            (self._span(place, k) / span, span)
            for k, span in spans.items()
            if span > 0 and self._with(place, k)
        )
        half, passed = 0.5 * sum(span for _, span in ratios), 0.0
        for ratio, span in ratios:
            passed += span
            if passed >= half:
                return ratio
        return 1.0

    def _with(self, place: Similarity, other_id: int) -> bool:
        """True if a keyframe exists, and has the same scale."""
        unit = self.scale_of.get(other_id, 1.0)
        return other_id in self.map_from_camera and abs(unit / place.scale - 1.0) < 1e-9

    def _span(self, place: Similarity, other_id: int) -> float:
        away = self.map_from_camera[other_id].translation - place.translation
        return float(np.linalg.norm(away)) / place.scale


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
    Frame | Telemetry | Track | Odometry | KeyframeAdded | LoopClosed | MapUpdate | DepthMap
    | PointChunk | Warned | Georeferenced | FrameTracked | FrameOverdue | OpticalFlow
    | LandingTarget | SiteMapUsed | MapTakenUp
)  # fmt: skip
