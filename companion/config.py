"""Configuration: all sections and keys, with defaults.

Each section is a frozen dataclass; a stage takes its own section only. `config/companion.toml`
describes every key. An unknown key or a wrong type is a ConfigError that names the nearest key.

A key is a bool, int, float, str or a list of these last; `Annotated` with a `Range` or `OneOf`
gives its valid values, which are checked where a configuration is read (`companion.config_file`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated


@dataclass(frozen=True, slots=True)
class Range:
    """Values from `least` to `most`, both included."""

    least: float
    most: float = math.inf

    def allows(self, value: float) -> bool:
        """Whether a key may have this value."""
        return self.least <= value <= self.most

    def __str__(self) -> str:
        if math.isinf(self.most):
            return f"{self.least:g} or more"
        return f"{self.least:g} to {self.most:g}"


@dataclass(frozen=True, slots=True)
class OneOf:
    """One of a few words."""

    words: tuple[str, ...]

    def allows(self, value: str) -> bool:
        """Whether a key may have this value."""
        return value in self.words

    def __str__(self) -> str:
        return "one of " + ", ".join(self.words)


@dataclass(frozen=True, slots=True)
class CameraConfig:
    """The camera: source of a live run, image format, calibration."""

    source: Annotated[str, OneOf(("v4l2", "gstreamer", "network", "file", "pattern"))] = "v4l2"
    """Kind of camera of a live run."""
    device: str = "auto"
    """v4l2: a path, preferably in /dev/v4l/by-id; "auto" takes the only camera."""
    pipeline: str = ""
    """gstreamer: the pipeline up to, not including, its appsink."""
    url: str = ""
    """network: rtsp://… or any other URL that FFmpeg opens."""
    transport: Annotated[str, OneOf(("tcp", "udp"))] = "tcp"
    """network: transport of RTSP."""
    path: str = ""
    """file: a flight folder, a folder of images, or a video, played in real time."""
    topic: str = ""
    """Image topic of a replayed bag; "" takes the one with most images."""
    repeat: bool = False
    """file: repeat at the end; else the camera is silent from then on."""
    starts_at_unix_s: Annotated[float, Range(0, 1e11)] = 0.0
    """file: time of its first image; 0: when the camera is opened."""
    width: Annotated[int, Range(32, 8192)] = 640
    height: Annotated[int, Range(32, 8192)] = 480
    rate_hz: Annotated[float, Range(1, 240)] = 30.0
    pixel_format: str = "auto"
    """v4l2: a four-letter code such as YUYV or MJPG."""
    exposure_us: Annotated[int, Range(0, 1000000)] = 0
    """v4l2: exposure time; 0 leaves it to the camera."""
    gain: Annotated[int, Range(-1, 100000)] = -1
    """v4l2: in the camera's own steps; -1 leaves it to the camera."""
    focus: Annotated[int, Range(-1, 100000)] = -1
    """v4l2: in the camera's own steps; -1 leaves it to the camera."""
    stamp_offset_ms: Annotated[float, Range(-1000, 1000)] = 0.0
    """Added to stamps: from the source's stamp to mid-exposure."""
    calibration: str = ""
    """Calibration file of a live camera, as `companion calibrate` writes it."""
    assumed_hfov_deg: Annotated[float, Range(0, 150)] = 75.0
    """Horizontal field of view assumed without a calibration; 0: refuse."""


@dataclass(frozen=True, slots=True)
class MountConfig:
    """Mounting of a live camera on the body, where its calibration file lacks it.

    The angles rotate a camera that looks forward, upright: first by yaw to the right, then by pitch
    upwards, then by roll clockwise about its own axis.
    """

    known: bool = False
    """Whether the mounting is given; without it the autopilot's attitude cannot be used."""
    roll_deg: Annotated[float, Range(-180, 180)] = 0.0
    pitch_deg: Annotated[float, Range(-180, 180)] = 0.0
    """-90 looks straight down."""
    yaw_deg: Annotated[float, Range(-180, 180)] = 0.0
    x_m: Annotated[float, Range(-100, 100)] = 0.0
    """Position of the lens relative to the autopilot: forward, right, down."""
    y_m: Annotated[float, Range(-100, 100)] = 0.0
    z_m: Annotated[float, Range(-100, 100)] = 0.0


@dataclass(frozen=True, slots=True)
class LinkConfig:
    """The autopilot's link."""

    url: str = ""
    """serial:DEVICE:BAUD, udpin:HOST:PORT, udpout:HOST:PORT or tcp:HOST:PORT; "" for none. Baud
    "auto" is detected."""
    backend: Annotated[str, OneOf(("pymavlink", "mavsdk"))] = "pymavlink"
    system_id: Annotated[int, Range(0, 255)] = 0
    """The vehicle's; 0 takes the first autopilot heard."""
    component_id: Annotated[int, Range(1, 255)] = 197
    """Ours; 197 is MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY."""
    attitude_hz: Annotated[float, Range(0, 400)] = 50.0
    """Rate requested from the autopilot; 0 requests none."""
    imu_hz: Annotated[float, Range(0, 1000)] = 0.0
    position_hz: Annotated[float, Range(0, 100)] = 10.0
    """Local, global and GPS position."""
    height_hz: Annotated[float, Range(0, 100)] = 10.0
    """Pressure and rangefinder."""
    timesync_hz: Annotated[float, Range(0.1, 50)] = 10.0
    silent_after_s: Annotated[float, Range(0.2, 60)] = 3.0
    """Silence after which the autopilot counts as lost."""
    signing_key_file: str = ""
    """A file with 64 hexadecimal digits; "" for unsigned MAVLink."""


@dataclass(frozen=True, slots=True)
class RouterConfig:
    """Router: other programs that share the autopilot's link."""

    clients: tuple[str, ...] = ()
    """udpin:HOST:PORT, udpout:HOST:PORT or tcpin:HOST:PORT each; HOST may be left out: loopback."""
    queue_kb: Annotated[int, Range(4, 65536)] = 256
    """Size of a client's queue; the oldest packets are dropped."""


@dataclass(frozen=True, slots=True)
class FeedbackConfig:
    """Poses sent to the autopilot."""

    mode: Annotated[str, OneOf(("off", "odometry", "vision_position"))] = "off"
    rate_hz: Annotated[float, Range(4, 100)] = 30.0
    """Least rate of poses; between frames they are predicted."""
    max_sigma_m: Annotated[float, Range(0.01, 100)] = 1.0
    """Positions with a larger standard deviation are not sent."""
    min_quality: Annotated[int, Range(1, 100)] = 20
    """Poses of a lower quality are not sent."""
    max_gap_ms: Annotated[float, Range(30, 300)] = 200.0
    """Longest prediction after the frame that a pose is from."""
    resume_after_s: Annotated[float, Range(0.1, 60)] = 1.0
    """The gate must have accepted poses for this long before they are sent again."""
    max_jump_m: Annotated[float, Range(0.05, 100)] = 1.0
    """Largest innovation of a pose against the predicted motion before it counts as a reset."""
    set_origin: bool = True
    """Set an origin on an autopilot that has none, so that it can use a pose."""
    origin_latitude_deg: Annotated[float, Range(-90, 90)] = 0.0
    """That origin, where no GPS has given one."""
    origin_longitude_deg: Annotated[float, Range(-180, 180)] = 0.0
    origin_altitude_m: Annotated[float, Range(-500, 9000)] = 0.0
    obstacle_distance: bool = False
    """Send OBSTACLE_DISTANCE from the newest part of the cloud."""


@dataclass(frozen=True, slots=True)
class ControlConfig:
    """Commands and parameters of ground stations over MAVLink; see docs/control.md."""

    enabled: bool = True
    keep: str = ""
    """TOML file that keeps settings from the ground; read at the start, after all else. "" keeps
    nothing."""


@dataclass(frozen=True, slots=True)
class DaemonConfig:
    """The daemon."""

    flights: str = "flights"
    """Folder of the flights' folders."""
    flight: Annotated[str, OneOf(("armed", "always"))] = "armed"
    """A flight lasts from arming to disarming, or as long as the daemon runs."""
    missing_device_s: Annotated[float, Range(0, 3600)] = 60.0
    """Time after which a missing camera or autopilot ends the daemon with status 1, unless armed;
    0: never."""
    socket: str = "auto"
    """Unix socket of `companion status`; "auto" lies in $RUNTIME_DIRECTORY or $XDG_RUNTIME_DIR."""
    prometheus_port: Annotated[int, Range(0, 65535)] = 0
    """Loopback port of metrics; 0 for none."""
    status_every_s: Annotated[float, Range(1, 3600)] = 10.0
    """Interval of status lines in the journal."""
    viewer: str = "none"
    """none, web, native, or the rerun+http://… of a running viewer."""
    hot_c: Annotated[float, Range(30, 120)] = 85.0
    """Temperature of the processor above which the load level is reduced."""


@dataclass(frozen=True, slots=True)
class RecorderConfig:
    """The recording of a live flight."""

    enabled: bool = True
    codec: Annotated[str, OneOf(("mjpeg", "h264", "png", "raw"))] = "mjpeg"
    """Image codec; png and raw are lossless."""
    jpeg_quality: Annotated[int, Range(30, 100)] = 90
    h264_encoder: str = "auto"
    """Name of an FFmpeg encoder; "auto" takes one in hardware, else libx264."""
    h264_kbit_s: Annotated[int, Range(100, 100000)] = 6000
    flush_s: Annotated[float, Range(0.1, 10)] = 0.5
    """Data older than twice this is on disk, whatever happens."""
    buffer_mb: Annotated[int, Range(4, 4096)] = 64
    """Size of the queue to a slow disk; beyond it messages are dropped, images first."""
    point_cloud: bool = False
    """Record the dense points too, which a replay can recompute."""
    least_free_mb: Annotated[int, Range(0, 1000000)] = 1000
    """Least free disk space; below it space is made, or the recording ends."""
    when_full: Annotated[str, OneOf(("prune", "stop"))] = "prune"
    """Delete the oldest flights, or stop recording."""


@dataclass(frozen=True, slots=True)
class TelemetryConfig:
    """Time alignment of the autopilot's log with the flight's clock."""

    log: str = ""
    """The log to read; "" takes the one beside the images."""
    align: Annotated[str, OneOf(("auto", "never"))] = "auto"
    """Whether a log is aligned with a video without frames.csv by the rotation of both."""
    offset_s: Annotated[float, Range(-1e10, 1e10)] = 0.0
    """Added to all times of the log, for a log or a video whose clock was set wrong."""
    starts_with_video: bool = False
    """Whether a log without absolute time begins with the video; else it is not used."""


@dataclass(frozen=True, slots=True)
class FeaturesConfig:
    """The ORB front end."""

    n_features: Annotated[int, Range(100, 20000)] = 1200
    n_levels: Annotated[int, Range(1, 16)] = 8
    scale_factor: Annotated[float, Range(1.05, 2)] = 1.2
    fast_threshold: Annotated[int, Range(1, 255)] = 12
    """Initial FAST threshold, grey levels; it adapts to the scene."""
    min_fast_threshold: Annotated[int, Range(1, 255)] = 4
    """Least threshold, for scenes of low contrast."""
    max_fast_threshold: Annotated[int, Range(1, 255)] = 60
    """Largest threshold, for scenes so rich that all corners would take too long."""
    cell_px: Annotated[int, Range(8, 512)] = 32
    """Cell size of the grid over which features are distributed."""


@dataclass(frozen=True, slots=True)
class TrackingConfig:
    """Tracking and keyframes."""

    min_inliers: Annotated[int, Range(6, 1000)] = 20
    """Least map points found; with fewer the frame is lost."""
    min_init_parallax_deg: Annotated[float, Range(0.1, 30)] = 1.0
    """Least parallax between the two initial keyframes."""
    keyframe_min_share: Annotated[float, Range(0.05, 1)] = 0.75
    """A keyframe is inserted when less than this share of the reference's points is seen."""
    keyframe_parallax_deg: Annotated[float, Range(0.1, 45)] = 3.0
    """A keyframe is inserted when the parallax of the points exceeds this."""
    keyframe_max_s: Annotated[float, Range(0.05, 3600)] = 3.0
    restart_after_s: Annotated[float, Range(0, 3600)] = 1.0
    """A camera lost for this long may begin a new segment of the map.

    With the autopilot's attitude after 0.4 of it.
    """


@dataclass(frozen=True, slots=True)
class MappingConfig:
    """Triangulation and bundle adjustment."""

    window: Annotated[int, Range(2, 100)] = 10
    """Keyframes adjusted together."""
    n_fixed: Annotated[int, Range(1, 200)] = 10
    """Older keyframes that see the same points, held fixed."""
    iterations: Annotated[int, Range(1, 100)] = 6
    final_iterations: Annotated[int, Range(1, 100)] = 8
    """Iterations of the full bundle adjustment at the end of the flight."""
    keyframe_spacing_deg: Annotated[float, Range(0, 45)] = 1.0
    """Keyframes closer than this, seen from their points, are culled if redundant; 0: none."""


@dataclass(frozen=True, slots=True)
class GeoreferenceConfig:
    """Scale, heading and origin from the autopilot."""

    min_travel_m: Annotated[float, Range(0.1, 10000)] = 3.0
    """Least distance flown before a scale is estimated."""
    max_sigma_scale: Annotated[float, Range(0.001, 1)] = 0.1
    """Largest relative standard deviation of the scale."""


@dataclass(frozen=True, slots=True)
class OpenclConfig:
    """OpenCL device."""

    device: str = "auto"
    """"auto" (the fastest that computes right), or a part of a device's or platform's name, or
    "platform:device" by number."""


@dataclass(frozen=True, slots=True)
class DepthConfig:
    """The dense depth filter."""

    enabled: bool = True
    stride: Annotated[int, Range(1, 8)] = 2
    """Pixel step of depth estimation; images are matched at full size."""
    reference_step: Annotated[float, Range(0, 10)] = 0.15
    """Least distance between keyframes with a depth map, as a share of the depth."""
    n_updates: Annotated[int, Range(3, 100)] = 7
    """Frames per depth map, chosen by their baselines."""
    max_baseline: Annotated[float, Range(0.01, 1)] = 0.20
    """Longest baseline used, as a share of the median depth."""
    lag_keyframes: Annotated[int, Range(1, 20)] = 2
    """Number of later keyframes to wait for, whose frames and adjusted poses are used."""
    min_zncc: Annotated[float, Range(0, 1)] = 0.5
    """Least correlation (ZNCC) of a matching image."""
    noise_grey: Annotated[float, Range(0, 50)] = 1.0
    """Patches whose grey levels vary less than this have no texture."""
    converged_sigma: Annotated[float, Range(0.0001, 0.1)] = 0.02
    """Relative standard deviation at which a pixel has converged."""
    min_inlier_ratio: Annotated[float, Range(0, 1)] = 0.35
    """Least share of matching images of a converged pixel; some may not see it."""
    regularise_iterations: Annotated[int, Range(0, 1000)] = 60
    regularise_weight: Annotated[float, Range(0.001, 1000)] = 20.0
    """Weight of the measurements against smoothness."""


@dataclass(frozen=True, slots=True)
class CloudConfig:
    """The fused cloud."""

    voxel_m: Annotated[float, Range(0.001, 100)] = 0.10
    """Voxel size of the cloud; a hundredth of the median depth without a metric scale."""
    min_agreeing: Annotated[int, Range(0, 4)] = 2
    """Number of other keyframes whose depth must agree with a point's."""
    agreement: Annotated[float, Range(0.001, 0.2)] = 0.015
    """Largest relative difference of depths that agree."""
    memory_mb: Annotated[int, Range(1, 100000)] = 64
    """Points of a flight kept in memory; others are in the run's folder until it ends."""


@dataclass(frozen=True, slots=True)
class StreamConfig:
    """Streaming to viewers on the ground; see companion.streaming."""

    listen: str = "127.0.0.1:9870"
    """HOST:PORT at which viewers connect; "" for none. 0.0.0.0 is every network."""
    budget_kbit_s: Annotated[float, Range(0, 1e6)] = 0.0
    """Rate limit of all viewers together; 0: as much as the link carries."""
    most_viewers: Annotated[int, Range(1, 16)] = 4
    web_bind: str = "127.0.0.1"
    """Address at which daemon.viewer = "web" serves its page; 0.0.0.0 is every network."""
    store_mb: Annotated[int, Range(1, 4096)] = 128
    """Points kept for viewers that join late; beyond it the finest are dropped first."""


@dataclass(frozen=True, slots=True)
class DistributedConfig:
    """Stages on several machines, joined by topics over Zenoh; see docs/topics.md."""

    enabled: bool = False
    """Publish the topics. Needs the extra of the same name."""
    stages: tuple[str, ...] = ("tracking", "depth", "cloud")
    """Stages of this node: all, tracking alone, or depth and cloud."""
    vehicle: str = "drone"
    """Name of the drone in keys; nodes of one drone have the same."""
    listen: tuple[str, ...] = ()
    """Endpoints to listen at, as tcp/0.0.0.0:7447; none: loopback, if tracking runs here."""
    connect: tuple[str, ...] = ()
    """Endpoints to connect to, as tcp/192.168.1.20:7447."""
    budget_kbit_s: Annotated[float, Range(0, 1e6)] = 8000.0
    """Rate limit of the bundles for depth nodes; 0 is no limit."""
    jpeg_quality: Annotated[int, Range(30, 100)] = 90
    """JPEG quality of frames for depth nodes."""
    backlog_mb: Annotated[int, Range(1, 4096)] = 64
    """Frames kept for a node that is away or joins late; the oldest are dropped."""


@dataclass(frozen=True, slots=True)
class ViewerConfig:
    """The recording and the live viewer."""

    colours: Annotated[str, OneOf(("picture", "height", "confidence"))] = "picture"
    """Colour mode of the cloud."""
    rrd_mb: Annotated[int, Range(0, 1000000)] = 4000
    """Size limit of a flight's .rrd files; the oldest are deleted. 0 for no limit."""

    jpeg_quality: Annotated[int, Range(1, 100)] = 60
    image_width: Annotated[int, Range(32, 8192)] = 640


@dataclass(frozen=True, slots=True)
class ExportConfig:
    """Exports that a replay writes beside its results; `companion export` does so afterwards."""

    formats: tuple[str, ...] = ()
    """ply, pcd, las, laz, dsm, ortho, tum, kitti, euroc, gpx, kml, geojson."""
    epsg: Annotated[int, Range(0, 999999)] = 0
    """Projection of clouds and rasters; 0: UTM zone of the flight."""
    cell_m: Annotated[float, Range(0, 1000)] = 0.0
    """Cell size of rasters; 0: twice the spacing of the cloud's points."""


@dataclass(frozen=True, slots=True)
class Config:
    """All sections."""

    camera: CameraConfig = field(default_factory=CameraConfig)
    mount: MountConfig = field(default_factory=MountConfig)
    link: LinkConfig = field(default_factory=LinkConfig)
    router: RouterConfig = field(default_factory=RouterConfig)
    feedback: FeedbackConfig = field(default_factory=FeedbackConfig)
    control: ControlConfig = field(default_factory=ControlConfig)
    daemon: DaemonConfig = field(default_factory=DaemonConfig)
    recorder: RecorderConfig = field(default_factory=RecorderConfig)
    telemetry: TelemetryConfig = field(default_factory=TelemetryConfig)
    features: FeaturesConfig = field(default_factory=FeaturesConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    georeference: GeoreferenceConfig = field(default_factory=GeoreferenceConfig)
    opencl: OpenclConfig = field(default_factory=OpenclConfig)
    depth: DepthConfig = field(default_factory=DepthConfig)
    cloud: CloudConfig = field(default_factory=CloudConfig)
    stream: StreamConfig = field(default_factory=StreamConfig)
    distributed: DistributedConfig = field(default_factory=DistributedConfig)
    viewer: ViewerConfig = field(default_factory=ViewerConfig)
    export: ExportConfig = field(default_factory=ExportConfig)
