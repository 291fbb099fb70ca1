"""Configuration: all sections and keys, with defaults.

Each section is a frozen dataclass; a stage takes its own section only. The text below a key says
what it is for; `config/companion.toml` and docs/settings.md are made of these texts. A key marked
`Expert` is set under `[expert.SECTION]`. `Meta` and `Literal` give the valid values, which are
checked where a configuration is read (`companion.config_file`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal, TypeVar, get_args

from msgspec import Meta

T = TypeVar("T")
EXPERT = "expert"
Expert = Annotated[T, EXPERT]
"""A key that few drones need: its default was found by tests, or fits nearly all."""
Measurement = Literal["attitude", "imu", "position", "satellites", "range", "height", "airspeed"]
"""A kind of measurement, as `telemetry.use` names it."""
MEASUREMENTS: tuple[Measurement, ...] = get_args(Measurement)


@dataclass(frozen=True, slots=True)
class CameraConfig:
    """The camera of a live run: source, image format, calibration."""

    source: Literal["v4l2", "gstreamer", "network", "file", "pattern"] = "v4l2"
    """Kind of camera: v4l2 is a USB camera, pattern a drawn picture for tests."""
    device: str = "auto"
    """v4l2: a path, preferably in /dev/v4l/by-id; "auto" takes the only camera."""
    pipeline: str = ""
    """gstreamer: the pipeline up to, not including, its appsink."""
    url: str = ""
    """network: rtsp://… or any other URL that FFmpeg opens."""
    path: str = ""
    """file: a flight folder, a folder of images, or a video, played in real time."""
    width: Annotated[int, Meta(ge=32, le=8192)] = 640
    """Image width requested from the camera, pixels."""
    height: Annotated[int, Meta(ge=32, le=8192)] = 480
    """Image height requested from the camera, pixels."""
    rate_hz: Annotated[float, Meta(ge=1, le=240)] = 30.0
    """Frame rate requested from the camera, Hz."""
    exposure_us: Annotated[int, Meta(ge=0, le=1000000)] = 0
    """v4l2: exposure time, microseconds; 0 leaves it to the camera."""
    stamp_offset_ms: Annotated[float, Meta(ge=-1000, le=1000)] = 0.0
    """Added to stamps, milliseconds: from the source's stamp to mid-exposure."""
    calibration: str = ""
    """Calibration file of a live camera, as `companion calibrate` writes it."""
    readout_ms: Annotated[float, Meta(ge=-1, le=200)] = -1.0
    """Rolling shutter: from the exposure of the first row to that of the last, milliseconds; 0 for
    a global one, -1: as the calibration says."""
    assumed_hfov_deg: Annotated[float, Meta(ge=0, le=150)] = 75.0
    """Horizontal field of view assumed without a calibration, degrees; 0: refuse."""
    pixel_format: Expert[str] = "auto"
    """v4l2: a four-letter code such as YUYV or MJPG."""
    gain: Expert[Annotated[int, Meta(ge=-1, le=100000)]] = -1
    """v4l2: in the camera's own steps; -1 leaves it to the camera."""
    focus: Expert[Annotated[int, Meta(ge=-1, le=100000)]] = -1
    """v4l2: in the camera's own steps; -1 leaves it to the camera."""
    transport: Expert[Literal["tcp", "udp"]] = "tcp"
    """network: transport of RTSP."""
    repeat: Expert[bool] = False
    """file: repeat at the end; else the camera is silent from then on."""
    starts_at_unix_s: Expert[Annotated[float, Meta(ge=0, le=1e11)]] = 0.0
    """file: Unix time of its first image; 0: when the camera is opened."""
    topic: Expert[str] = ""
    """Image topic of a replayed bag; "" takes the one with most images."""


@dataclass(frozen=True, slots=True)
class MountConfig:
    """Mounting of a live camera on the body, where its calibration file lacks it.

    The angles rotate a camera that looks forward, upright: first by yaw to the right, then by pitch
    upwards, then by roll clockwise about its own axis.
    """

    known: bool = False
    """The angles below are those of the camera; else the autopilot's attitude cannot be used."""
    roll_deg: Annotated[float, Meta(ge=-180, le=180)] = 0.0
    """Roll of the camera, degrees."""
    pitch_deg: Annotated[float, Meta(ge=-180, le=180)] = 0.0
    """Pitch of the camera, degrees; -90 looks straight down."""
    yaw_deg: Annotated[float, Meta(ge=-180, le=180)] = 0.0
    """Yaw of the camera, degrees."""
    x_m: Annotated[float, Meta(ge=-100, le=100)] = 0.0
    """Position of the lens forward of the autopilot, metres."""
    y_m: Annotated[float, Meta(ge=-100, le=100)] = 0.0
    """Position of the lens to the right of the autopilot, metres."""
    z_m: Annotated[float, Meta(ge=-100, le=100)] = 0.0
    """Position of the lens below the autopilot, metres."""


@dataclass(frozen=True, slots=True)
class LinkConfig:
    """The autopilot's link."""

    url: str = ""
    """serial:DEVICE:BAUD, udpin:HOST:PORT, udpout:HOST:PORT or tcp:HOST:PORT; "" for none. Baud
    "auto" is detected."""
    system_id: Annotated[int, Meta(ge=0, le=255)] = 0
    """MAVLink system id of the vehicle; 0 takes the first autopilot heard."""
    signing_key_file: str = ""
    """A file with 64 hexadecimal digits, to sign MAVLink; "" for unsigned."""
    component_id: Expert[Annotated[int, Meta(ge=1, le=255)]] = 197
    """Ours; 197 is MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY."""
    backend: Expert[Literal["pymavlink", "mavsdk"]] = "pymavlink"
    """Library that holds the wire."""
    attitude_hz: Expert[Annotated[float, Meta(ge=0, le=400)]] = 50.0
    """Rate of the attitude requested from the autopilot, Hz; 0 requests none, here and below."""
    imu_hz: Expert[Literal["auto"] | Annotated[float, Meta(ge=0, le=1000)]] = "auto"
    """Rate of accelerations and rates of turn, Hz; "auto" is 100, or less where the link carries
    less, and none below 50. They give the scale where there are neither satellites nor a
    rangefinder."""
    position_hz: Expert[Annotated[float, Meta(ge=0, le=100)]] = 10.0
    """Rate of local, global and GPS position, Hz."""
    height_hz: Expert[Annotated[float, Meta(ge=0, le=100)]] = 10.0
    """Rate of pressure and rangefinder, Hz."""
    silent_after_s: Expert[Annotated[float, Meta(ge=0.2, le=60)]] = 3.0
    """Silence after which the autopilot counts as lost, seconds."""


@dataclass(frozen=True, slots=True)
class RouterConfig:
    """Router: other programs that share the autopilot's link."""

    clients: tuple[str, ...] = ()
    """udpin:HOST:PORT, udpout:HOST:PORT or tcpin:HOST:PORT each, such as "tcpin::5760"; HOST may be
    left out: loopback."""
    queue_kb: Expert[Annotated[int, Meta(ge=4, le=65536)]] = 256
    """Size of a client's queue, kilobytes; the oldest packets are dropped."""


@dataclass(frozen=True, slots=True)
class FeedbackConfig:
    """Poses sent to the autopilot; while armed limits only tighten, see docs/control.md."""

    mode: Literal["off", "odometry", "vision_position"] = "off"
    """ODOMETRY, or for older firmware VISION_POSITION_ESTIMATE."""
    global_position: Literal["off", "sensor", "estimate", "gps_input"] = "off"
    """Send latitude and longitude while satellites are not in use, and mode is off: sensor is
    GLOBAL_POSITION_SENSOR for PX4, estimate MAV_CMD_EXTERNAL_POSITION_ESTIMATE for ArduPilot,
    gps_input GPS_INPUT for others; see docs/global_position.md."""
    rate_hz: Annotated[float, Meta(ge=4, le=100)] = 30.0
    """Least rate of poses, Hz; between frames they are predicted."""
    max_sigma_m: Annotated[float, Meta(ge=0.01, le=100)] = 1.0
    """Positions with a larger standard deviation are not sent, metres."""
    min_quality: Annotated[int, Meta(ge=1, le=100)] = 20
    """Poses of a lower quality are not sent."""
    max_gap_ms: Annotated[float, Meta(ge=30, le=300)] = 200.0
    """Longest prediction after the frame that a pose is from, milliseconds."""
    resume_after_s: Annotated[float, Meta(ge=0.1, le=60)] = 1.0
    """The gate must have accepted poses for this long before they are sent again, seconds; after
    frames that were missing for a shorter time, and of which none was refused, for that time."""
    max_jump_m: Annotated[float, Meta(ge=0.05, le=100)] = 1.0
    """Largest innovation of a pose against the predicted motion, metres; beyond, it is a reset."""
    set_origin: bool = True
    """Set an origin on an autopilot that has none, so that it can use a pose."""
    origin_latitude_deg: Annotated[float, Meta(ge=-90, le=90)] = 0.0
    """Latitude of that origin where no GPS has given one, degrees."""
    origin_longitude_deg: Annotated[float, Meta(ge=-180, le=180)] = 0.0
    """Its longitude, degrees."""
    origin_altitude_m: Annotated[float, Meta(ge=-500, le=9000)] = 0.0
    """Its altitude above mean sea level, metres."""
    flow: Literal["off", "optical_flow", "optical_flow_rad"] = "off"
    """Send the flow of the ground from the first two frames on, without any scale: OPTICAL_FLOW
    for ArduPilot, OPTICAL_FLOW_RAD for PX4."""
    obstacle_distance: bool = False
    """Send OBSTACLE_DISTANCE from the newest part of the cloud."""

    @property
    def gives_position(self) -> bool:
        """True if the autopilot may fly on our position: its own estimates may then be ours."""
        return self.mode != "off" or self.global_position != "off"


@dataclass(frozen=True, slots=True)
class LandingConfig:
    """A marker to land on, seen by the flight's camera; see docs/landing.md."""

    marker: Literal["off", "apriltag_36h11", "aruco_4x4_50", "aruco_5x5_100", "aruco_6x6_250"] = (
        "off"
    )
    """Family of the marker; off looks for none."""
    id: Annotated[int, Meta(ge=0, le=586)] = 0
    """Number of the marker within its family; others are ignored."""
    size_m: Annotated[float, Meta(ge=0, le=20)] = 0.0
    """Length of an edge of its black square, metres; must be stated where a marker is set."""


@dataclass(frozen=True, slots=True)
class GpsConfig:
    """Satellites that vision contradicts; see docs/satellites.md."""

    switch_source: bool = False
    """Switch ArduPilot's EKF to other sources while satellites are doubted and poses are sent."""
    vision_set: Annotated[int, Meta(ge=1, le=3)] = 2
    """Source set (EK3_SRC2_… is 2) without satellites, switched to when they are doubted."""
    satellites_set: Annotated[int, Meta(ge=1, le=3)] = 1
    """Source set with satellites, switched back to when they agree again."""


@dataclass(frozen=True, slots=True)
class ControlConfig:
    """Commands and parameters of ground stations over MAVLink; see docs/control.md."""

    enabled: bool = True
    """Let ground stations give commands and set parameters."""
    keep: str = ""
    """TOML file that keeps settings from the ground, read after all else; "" keeps nothing."""


@dataclass(frozen=True, slots=True)
class DaemonConfig:
    """The daemon, `companion run`."""

    flights: str = "flights"
    """Folder of the flights' folders."""
    flight: Literal["armed", "always"] = "armed"
    """A flight is kept once the motors were armed; or always, from the first frame until the daemon
    ends."""
    viewer: str = "none"
    """none, web, native, or the rerun+http://… of a running viewer."""
    hot_c: Annotated[float, Meta(ge=30, le=120)] = 85.0
    """Temperature of the processor above which the load level is reduced, Celsius."""
    missing_device_s: Expert[Annotated[float, Meta(ge=0, le=3600)]] = 60.0
    """Seconds after which a missing camera or autopilot ends the daemon, unless armed; 0: never."""
    socket: Expert[str] = "auto"
    """Unix socket of `companion status`; "auto" lies in $RUNTIME_DIRECTORY or $XDG_RUNTIME_DIR."""
    prometheus_port: Expert[Annotated[int, Meta(ge=0, le=65535)]] = 0
    """Loopback port of metrics; 0 for none."""
    status_every_s: Expert[Annotated[float, Meta(ge=1, le=3600)]] = 10.0
    """Interval of status lines in the journal, seconds."""


@dataclass(frozen=True, slots=True)
class RecorderConfig:
    """The recording of a live flight: flight.mcap, and flight.tlog for ground stations."""

    enabled: bool = True
    """Record live flights."""
    codec: Literal["mjpeg", "h264", "png", "raw"] = "mjpeg"
    """Image codec; h264 is smaller and more work, png and raw are lossless."""
    least_free_mb: Annotated[int, Meta(ge=0, le=1000000)] = 1000
    """Least free disk space, megabytes; below it the oldest flights are deleted, but those with a
    file named keep."""
    when_full: Expert[Literal["prune", "stop"]] = "prune"
    """Action below least_free_mb: delete the oldest flights, or stop recording."""
    jpeg_quality: Expert[Annotated[int, Meta(ge=30, le=100)]] = 90
    """Quality of mjpeg."""
    h264_encoder: Expert[str] = "auto"
    """Name of an FFmpeg encoder; "auto" takes one in hardware, else libx264."""
    h264_kbit_s: Expert[Annotated[int, Meta(ge=100, le=100000)]] = 6000
    """Bit rate of h264, kbit/s."""
    flush_s: Expert[Annotated[float, Meta(ge=0.1, le=10)]] = 0.5
    """Data older than twice this is on disk, whatever happens, seconds."""
    buffer_mb: Expert[Annotated[int, Meta(ge=4, le=4096)]] = 64
    """Size of the queue to a slow disk; beyond it messages are dropped, images first."""
    point_cloud: Expert[bool] = False
    """Record the dense points too, which a replay can recompute."""


@dataclass(frozen=True, slots=True)
class TelemetryConfig:
    """Telemetry of the autopilot: what is believed of it, and the time alignment of its log.

    What is not believed decides nothing about the pose, and is recorded as it comes.
    """

    use: tuple[Measurement, ...] = MEASUREMENTS
    """Kinds of measurement that are believed, each at most once. imu: accelerations and rates of
    turn; position: the autopilot's own estimate; satellites: GPS; range: rangefinder; height:
    barometer. Without attitude no pose is sent."""
    log: Expert[str] = ""
    """The log to read; "" takes the one beside the images."""
    align: Expert[Literal["auto", "never"]] = "auto"
    """Align a log with a video without frames.csv by the rotation of both."""
    offset_s: Expert[Annotated[float, Meta(ge=-1e10, le=1e10)]] = 0.0
    """Added to all times of the log, for a log or a video whose clock was set wrong, seconds."""
    starts_with_video: Expert[bool] = False
    """A log without absolute time begins with the video; else it is not used."""


@dataclass(frozen=True, slots=True)
class FeaturesConfig:
    """The ORB front end."""

    n_features: Expert[Annotated[int, Meta(ge=100, le=20000)]] = 1200
    """Features extracted from each frame."""
    n_levels: Expert[Annotated[int, Meta(ge=1, le=16)]] = 8
    """Levels of the image pyramid."""
    scale_factor: Expert[Annotated[float, Meta(ge=1.05, le=2)]] = 1.2
    """Scale from one level to the next."""


@dataclass(frozen=True, slots=True)
class TrackingConfig:
    """Tracking."""

    min_inliers: Expert[Annotated[int, Meta(ge=6, le=1000)]] = 20
    """Least map points found; with fewer the frame is lost."""
    restart_after_s: Expert[Annotated[float, Meta(ge=0, le=3600)]] = 1.0
    """A camera lost for this long may begin a new segment of the map, seconds; with the autopilot's
    attitude after 0.4 of it."""


@dataclass(frozen=True, slots=True)
class GeoreferenceConfig:
    """Scale, heading and origin from the autopilot."""

    min_travel_m: Expert[Annotated[float, Meta(ge=0.1, le=10000)]] = 3.0
    """Least distance flown before a scale is estimated, metres."""
    max_sigma_scale: Expert[Annotated[float, Meta(ge=0.001, le=1)]] = 0.1
    """Largest relative standard deviation of the scale."""


@dataclass(frozen=True, slots=True)
class MapConfig:
    """Maps of earlier flights; see docs/maps.md."""

    use: str = ""
    """Site map of an earlier flight, in which the camera is located as soon as it sees something
    known; "" for none."""


@dataclass(frozen=True, slots=True)
class OpenclConfig:
    """OpenCL device of the dense map; see docs/opencl.md."""

    device: str = "auto"
    """"auto" (the fastest that computes right), or a part of a device's or platform's name, or
    "platform:device" by number."""


@dataclass(frozen=True, slots=True)
class DepthConfig:
    """The dense map."""

    enabled: bool = True
    """Make the dense map; without it there are a trajectory and sparse points only."""
    stride: Annotated[int, Meta(ge=1, le=8)] = 2
    """Pixel step of depth estimation; images are matched at full size."""
    reference_step: Expert[Annotated[float, Meta(ge=0, le=10)]] = 0.15
    """Least distance between keyframes with a depth map, as a share of the depth."""
    max_baseline: Expert[Annotated[float, Meta(ge=0.01, le=1)]] = 0.20
    """Longest baseline used, as a share of the median depth."""
    min_zncc: Expert[Annotated[float, Meta(ge=0, le=1)]] = 0.5
    """Least correlation (ZNCC) of a matching image."""
    converged_sigma: Expert[Annotated[float, Meta(ge=0.0001, le=0.1)]] = 0.02
    """Relative standard deviation at which a pixel has converged."""
    min_inlier_ratio: Expert[Annotated[float, Meta(ge=0, le=1)]] = 0.35
    """Least share of matching images of a converged pixel; some may not see it."""
    regularise_iterations: Expert[Annotated[int, Meta(ge=0, le=1000)]] = 60
    """Iterations of smoothing of a finished depth map; 0: none."""
    regularise_weight: Expert[Annotated[float, Meta(ge=0.001, le=1000)]] = 20.0
    """Weight of the measurements against smoothness."""


@dataclass(frozen=True, slots=True)
class CloudConfig:
    """The fused cloud."""

    voxel_m: Annotated[float, Meta(ge=0.001, le=100)] = 0.10
    """Voxel size of the cloud, metres; a hundredth of the median depth without a metric scale."""
    min_agreeing: Expert[Annotated[int, Meta(ge=0, le=4)]] = 2
    """Number of other keyframes whose depth must agree with a point's."""
    agreement: Expert[Annotated[float, Meta(ge=0.001, le=0.2)]] = 0.015
    """Largest relative difference of depths that agree."""
    memory_mb: Expert[Annotated[int, Meta(ge=1, le=100000)]] = 64
    """Points of a flight kept in memory; others are in the run's folder until it ends."""


@dataclass(frozen=True, slots=True)
class StreamConfig:
    """Streaming to viewers on the ground (`companion view`); see docs/viewing.md."""

    listen: str = "127.0.0.1:9870"
    """HOST:PORT at which viewers connect; "" for none. 0.0.0.0 is every network."""
    budget_kbit_s: Annotated[float, Meta(ge=0, le=1e6)] = 0.0
    """Rate limit of all viewers together, kbit/s; 0: as much as the link carries."""
    web_bind: str = "127.0.0.1"
    """Address of the page of daemon.viewer = "web", ports 9090 and 9876; 0.0.0.0: all networks."""
    most_viewers: Expert[Annotated[int, Meta(ge=1, le=16)]] = 4
    """Viewers at once."""
    store_mb: Expert[Annotated[int, Meta(ge=1, le=4096)]] = 128
    """Points kept for viewers that join late; beyond it the finest are dropped first."""


@dataclass(frozen=True, slots=True)
class PageConfig:
    """The page on the drone, for a browser; see docs/page.md."""

    listen: str = "127.0.0.1:9880"
    """HOST:PORT of the page; "" for none. 0.0.0.0 is every network: whoever is not on this machine
    needs a code, which `companion page` shows."""


@dataclass(frozen=True, slots=True)
class VideoConfig:
    """The camera's pictures as video for pilots, as the map sees them; see docs/viewing.md."""

    listen: str = ""
    """HOST:PORT of an RTSP server, whose path is /camera; "" for none. 0.0.0.0 is every network."""
    kbit_s: Annotated[int, Meta(ge=50, le=50000)] = 2000
    """Bit rate of the video, kbit/s."""


@dataclass(frozen=True, slots=True)
class DistributedConfig:
    """Stages on several machines, joined by topics over Zenoh; see docs/topics.md."""

    enabled: bool = False
    """Publish the topics. Needs the extra of the same name."""
    vehicle: str = "drone"
    """Name of the drone in keys; nodes of one drone have the same."""
    listen: tuple[str, ...] = ()
    """Endpoints to listen at, as tcp/0.0.0.0:7447; none: loopback, if tracking runs here."""
    connect: tuple[str, ...] = ()
    """Endpoints to connect to, as tcp/192.168.1.20:7447."""
    stages: Expert[tuple[str, ...]] = ("tracking", "depth", "cloud")
    """Stages of this node, as `companion run --stages`: all, tracking alone, or depth and cloud."""
    budget_kbit_s: Expert[Annotated[float, Meta(ge=0, le=1e6)]] = 8000.0
    """Rate limit of the bundles for depth nodes, kbit/s; 0 is no limit."""
    jpeg_quality: Expert[Annotated[int, Meta(ge=30, le=100)]] = 90
    """JPEG quality of frames for depth nodes."""
    backlog_mb: Expert[Annotated[int, Meta(ge=1, le=4096)]] = 64
    """Frames kept for a node that is away or joins late; the oldest are dropped."""


@dataclass(frozen=True, slots=True)
class ViewerConfig:
    """The recording of the viewer, and the live viewer."""

    colours: Expert[Literal["picture", "height", "confidence"]] = "picture"
    """Colour mode of the cloud."""
    rrd_mb: Expert[Annotated[int, Meta(ge=0, le=1000000)]] = 4000
    """Size limit of a flight's .rrd files; the oldest are deleted. 0 for no limit."""
    jpeg_quality: Expert[Annotated[int, Meta(ge=1, le=100)]] = 60
    """JPEG quality of its images."""
    image_width: Expert[Annotated[int, Meta(ge=32, le=8192)]] = 640
    """Width of its images, pixels."""


@dataclass(frozen=True, slots=True)
class ExportConfig:
    """Exports that a replay writes beside its results; `companion export` does so afterwards."""

    formats: tuple[str, ...] = ()
    """ply, pcd, las, laz, copc, dsm, ortho, mosaic, glb, mesh, colmap, nerfstudio, tum, kitti,
    euroc, gpx, kml, geojson."""
    epsg: Expert[Annotated[int, Meta(ge=0, le=999999)]] = 0
    """Projection of clouds and rasters; 0: UTM zone of the flight."""
    cell_m: Expert[Annotated[float, Meta(ge=0, le=1000)]] = 0.0
    """Cell size of rasters, metres; 0: twice the spacing of the cloud's points, of `mosaic` what a
    pixel covers."""
    mesh_m: Expert[Annotated[float, Meta(ge=0, le=1000)]] = 0.0
    """Cell size of meshes, metres; 0: twice the spacing of the cloud's points."""


@dataclass(frozen=True, slots=True)
class Config:
    """All sections."""

    camera: CameraConfig = field(default_factory=CameraConfig)
    mount: MountConfig = field(default_factory=MountConfig)
    link: LinkConfig = field(default_factory=LinkConfig)
    router: RouterConfig = field(default_factory=RouterConfig)
    feedback: FeedbackConfig = field(default_factory=FeedbackConfig)
    landing: LandingConfig = field(default_factory=LandingConfig)
    gps: GpsConfig = field(default_factory=GpsConfig)
    control: ControlConfig = field(default_factory=ControlConfig)
    daemon: DaemonConfig = field(default_factory=DaemonConfig)
    recorder: RecorderConfig = field(default_factory=RecorderConfig)
    telemetry: TelemetryConfig = field(default_factory=TelemetryConfig)
    features: FeaturesConfig = field(default_factory=FeaturesConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    georeference: GeoreferenceConfig = field(default_factory=GeoreferenceConfig)
    map: MapConfig = field(default_factory=MapConfig)
    opencl: OpenclConfig = field(default_factory=OpenclConfig)
    depth: DepthConfig = field(default_factory=DepthConfig)
    cloud: CloudConfig = field(default_factory=CloudConfig)
    stream: StreamConfig = field(default_factory=StreamConfig)
    page: PageConfig = field(default_factory=PageConfig)
    video: VideoConfig = field(default_factory=VideoConfig)
    distributed: DistributedConfig = field(default_factory=DistributedConfig)
    viewer: ViewerConfig = field(default_factory=ViewerConfig)
    export: ExportConfig = field(default_factory=ExportConfig)
