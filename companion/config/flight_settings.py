"""The daemon, and what is kept of its flights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from companion.config.setting_kinds import Expert


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
    hot_c: Expert[Annotated[float, Meta(ge=30, le=120)]] = 85.0
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
    least_free_mb: Expert[Annotated[int, Meta(ge=0, le=1000000)]] = 1000
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
class MapConfig:
    """Maps of earlier flights; see docs/maps.md."""

    use: str = ""
    """Site map of an earlier flight, in which the camera is located as soon as it sees something
    known; "" for none."""


@dataclass(frozen=True, slots=True)
class ExportConfig:
    """Exports that a replay writes beside its results; `companion export` does so afterwards."""

    formats: Expert[tuple[str, ...]] = ()
    """ply, pcd, las, laz, copc, dsm, ortho, mosaic, glb, mesh, textured, tiles, colmap, nerfstudio,
    tum, kitti, euroc, gpx, kml, geojson."""
    epsg: Expert[Annotated[int, Meta(ge=0, le=999999)]] = 0
    """Projection of clouds and rasters; 0: UTM zone of the flight."""
    cell_m: Expert[Annotated[float, Meta(ge=0, le=1000)]] = 0.0
    """Cell size of rasters, metres; 0: twice the spacing of the cloud's points, of `mosaic` what a
    pixel covers."""
    mesh_m: Expert[Annotated[float, Meta(ge=0, le=1000)]] = 0.0
    """Cell size of meshes, metres; 0: twice the spacing of the cloud's points."""
