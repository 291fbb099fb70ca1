"""Viewers, the page, video, and other machines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from companion.config.setting_kinds import Address, Expert


@dataclass(frozen=True, slots=True)
class PageConfig:
    """The page on the drone, for a browser; see docs/page.md."""

    listen: Address = "127.0.0.1:9880"
    """HOST:PORT of the page; "" for none. 0.0.0.0 is every network: whoever is not on this machine
    needs a code, which `companion page` shows."""


@dataclass(frozen=True, slots=True)
class StreamConfig:
    """Streaming to viewers on the ground (`companion view`); see docs/viewing.md."""

    listen: Address = "127.0.0.1:9870"
    """HOST:PORT at which viewers connect; "" for none. 0.0.0.0 is every network."""
    budget_kbit_s: Expert[Annotated[float, Meta(ge=0, le=1e6)]] = 0.0
    """Rate limit of all viewers together, kbit/s; 0: as much as the link carries."""
    web_bind: Expert[str] = "127.0.0.1"
    """Address of the page of daemon.viewer = "web", ports 9090 and 9876; 0.0.0.0: all networks."""
    most_viewers: Expert[Annotated[int, Meta(ge=1, le=16)]] = 4
    """Viewers at once."""
    store_mb: Expert[Annotated[int, Meta(ge=1, le=4096)]] = 128
    """Points kept for viewers that join late; beyond it the finest are dropped first."""


@dataclass(frozen=True, slots=True)
class VideoConfig:
    """The camera's pictures as video for pilots, as the map sees them; see docs/viewing.md."""

    listen: Address = ""
    """HOST:PORT of an RTSP server, whose path is /camera; "" for none. 0.0.0.0 is every network."""
    kbit_s: Expert[Annotated[int, Meta(ge=50, le=50000)]] = 2000
    """Bit rate of the video, kbit/s."""
    overlay: tuple[Literal["points", "horizon", "depth"], ...] = ()
    """Drawn over the video, some of these: the points that are tracked, the horizon with the points
    of the compass, the newest depth map in a corner. Pictures of the recording stay as they are."""


@dataclass(frozen=True, slots=True)
class DistributedConfig:
    """Stages on several machines, joined by topics over Zenoh; see docs/topics.md."""

    enabled: bool = False
    """Publish the topics. Needs the extra of the same name."""
    vehicle: Expert[str] = "drone"
    """Name of the drone in keys; nodes of one drone have the same."""
    listen: tuple[str, ...] = ()
    """Endpoints to listen at, as tcp/0.0.0.0:7447; none: loopback, if tracking runs here."""
    connect: Expert[tuple[str, ...]] = ()
    """Endpoints to connect to, as tcp/192.168.1.20:7447; `companion run --join` gives others."""
    ros_domain: Expert[Annotated[int, Meta(ge=-1, le=232)]] = -1
    """Pose, cloud and keyframes' pictures for ROS 2 too, in this domain, as its rmw_zenoh finds
    them; -1: none."""
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
