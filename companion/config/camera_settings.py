"""The camera, and its mount."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from companion.config.setting_kinds import Expert


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
    exposure: Literal["camera", "tracking"] = "camera"
    """v4l2, and gstreamer with libcamerasrc or nvarguscamerasrc: tracking chooses exposure and gain
    so that motion blurs by 1.5 pixels at most; camera leaves them to it, but for exposure_us and
    gain."""
    exposure_us: Expert[Annotated[int, Meta(ge=0, le=1000000)]] = 0
    """v4l2: exposure time, microseconds; 0 leaves it to the camera."""
    stamp_offset_ms: Expert[Annotated[float, Meta(ge=-1000, le=1000)]] = 0.0
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
    upwards, then by roll clockwise about its own axis. On a gimbal they are those of the camera in
    the gimbal's head, zero as a rule, and the position is that of the head.
    """

    type: Literal["fixed", "gimbal"] = "fixed"
    """gimbal: its angles come with telemetry, and poses are sent only while they are known."""
    gimbal_delay_ms: Expert[Annotated[float, Meta(ge=-500, le=500)]] = 0.0
    """Delay of the stamps of the gimbal's angles, milliseconds: where its estimate begins."""
    gimbal_sigma_deg: Expert[Annotated[float, Meta(ge=0.01, le=30)]] = 1.0
    """One standard deviation of the gimbal's angles, degrees."""
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
