"""The autopilot's link and telemetry, and what is sent to it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from companion.config.setting_kinds import MEASUREMENTS, Expert, Measurement


@dataclass(frozen=True, slots=True)
class LinkConfig:
    """The autopilot's link."""

    url: str = ""
    """serial:DEVICE:BAUD, udpin:HOST:PORT, udpout:HOST:PORT or tcp:HOST:PORT; "" for none. Baud
    "auto" is detected."""
    system_id: Expert[Annotated[int, Meta(ge=0, le=255)]] = 0
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
    gimbal_hz: Expert[Annotated[float, Meta(ge=0, le=100)]] = 20.0
    """Rate requested of the gimbal's angles, where the camera is on one; 0: as it is sent."""
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
class TelemetryConfig:
    """Telemetry of the autopilot and beside it: what is believed, and the time alignment of a log.

    What is not believed decides nothing about the pose, and is recorded as it comes.
    """

    use: tuple[Measurement, ...] = MEASUREMENTS
    """Kinds of measurement that are believed, each at most once. imu: accelerations and rates of
    turn; position: the autopilot's own estimate; satellites: GPS; range: rangefinder; height:
    barometer; depth: by a second camera or a depth camera. Without attitude no pose is sent."""
    log: Expert[str] = ""
    """The log to read; "" takes the one beside the images."""
    align: Expert[Literal["auto", "never"]] = "auto"
    """Align a log with a video without frames.csv by the rotation of both."""
    offset_s: Expert[Annotated[float, Meta(ge=-1e10, le=1e10)]] = 0.0
    """Added to all times of the log, for a log or a video whose clock was set wrong, seconds."""
    starts_with_video: Expert[bool] = False
    """A log without absolute time begins with the video; else it is not used."""


@dataclass(frozen=True, slots=True)
class FeedbackConfig:
    """Poses sent to the autopilot; while armed limits only tighten, see docs/control.md."""

    mode: Literal["off", "odometry", "vision_position", "velocity"] = "off"
    """ODOMETRY, or for older firmware VISION_POSITION_ESTIMATE; velocity is the pose's velocity
    alone, beside satellites or a global position."""
    global_position: Literal["off", "sensor", "estimate", "gps_input"] = "off"
    """Send latitude and longitude while satellites are not in use, and no pose is sent: sensor is
    GLOBAL_POSITION_SENSOR for PX4, estimate MAV_CMD_EXTERNAL_POSITION_ESTIMATE for ArduPilot,
    gps_input GPS_INPUT for others; see docs/global_position.md."""
    rate_hz: Expert[Annotated[float, Meta(ge=4, le=100)]] = 30.0
    """Least rate of poses, Hz; between frames they are predicted."""
    max_sigma_m: Expert[Annotated[float, Meta(ge=0.01, le=100)]] = 1.0
    """Positions with a larger standard deviation are not sent, metres."""
    min_quality: Expert[Annotated[int, Meta(ge=1, le=100)]] = 20
    """Poses of a lower quality are not sent."""
    max_gap_ms: Expert[Annotated[float, Meta(ge=30, le=300)]] = 200.0
    """Longest prediction after the frame that a pose is from, milliseconds."""
    resume_after_s: Expert[Annotated[float, Meta(ge=0.1, le=60)]] = 1.0
    """The gate must have accepted poses for this long before they are sent again, seconds; after
    frames that were missing for a shorter time, and of which none was refused, for that time."""
    max_jump_m: Expert[Annotated[float, Meta(ge=0.05, le=100)]] = 1.0
    """Largest innovation of a pose against the predicted motion, metres; beyond, it is a reset."""
    set_origin: Expert[bool] = True
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
    """Send OBSTACLE_DISTANCE: what stands around the vehicle by the newest images and depths."""
    obstacles_3d: bool = False
    """Send it to ArduPilot as OBSTACLE_DISTANCE_3D instead: with heights, above and below too."""

    def poses_per_frame(self, frame_period_s: float) -> int:
        """Number of poses sent from one frame to the next; all but one are predicted."""
        return max(1, math.ceil(frame_period_s * self.rate_hz - 0.1))

    @property
    def sends_position(self) -> bool:
        """True if what is sent as a pose has a position."""
        return self.mode not in ("off", "velocity")

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
    vision_set: Expert[Annotated[int, Meta(ge=1, le=3)]] = 2
    """Source set (EK3_SRC2_… is 2) without satellites, switched to when they are doubted."""
    satellites_set: Expert[Annotated[int, Meta(ge=1, le=3)]] = 1
    """Source set with satellites, switched back to when they agree again."""


@dataclass(frozen=True, slots=True)
class ControlConfig:
    """Commands and parameters of ground stations over MAVLink; see docs/control.md."""

    enabled: bool = True
    """Let ground stations give commands and set parameters."""
    keep: Expert[str] = ""
    """TOML file that keeps settings from the ground, read after all else; "" keeps nothing."""
