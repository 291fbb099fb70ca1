"""Opens recorded flights; the format is recognised by content, not by name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from companion.config import CameraConfig, MountConfig, TelemetryConfig
from companion.errors import FlightError
from drivers.datasets.bag_flight import is_bag, is_ros2_folder, open_bag
from drivers.datasets.euroc import is_euroc, open_euroc
from drivers.datasets.flight_folder import has_pictures, is_flight_folder, open_flight_folder
from drivers.datasets.geotagged_stills import is_geotagged, open_geotagged
from drivers.datasets.kitti import is_kitti, open_kitti
from drivers.datasets.posed_folders import is_posed_folder, open_posed_folder
from drivers.datasets.tum_rgbd import is_tum_rgbd, open_tum_rgbd
from drivers.datasets.video_flight import is_video, open_video
from drivers.flight import Flight
from drivers.images.calibration_file import with_mount, with_readout
from drivers.recording.recording_as_flight import (
    is_recorded_folder,
    is_recording,
    open_recorded_folder,
    open_recording,
)
from drivers.telemetry.log_readers import READERS as LOGS


class Format(NamedTuple):
    """Format of recorded flights; `recognises` examines an existing file or folder."""

    name: str
    recognises: Callable[[Path], bool]
    open: Callable[[Path, CameraConfig, TelemetryConfig], Flight]


FILES = (
    Format("recording", is_recording, open_recording),
    Format("ROS bag", is_bag, open_bag),
    Format("video", is_video, open_video),
)
FOLDERS = (
    Format("ROS bag", is_ros2_folder, open_bag),
    Format("folder of a live flight", is_recorded_folder, open_recorded_folder),
    Format("flight folder", is_flight_folder, open_flight_folder),
    Format("EuRoC (ASL)", is_euroc, open_euroc),
    Format("KITTI odometry", is_kitti, open_kitti),
    Format("TUM RGB-D", is_tum_rgbd, open_tum_rgbd),
    Format("images with poses", is_posed_folder, open_posed_folder),
    Format("ROS bag", is_bag, open_bag),
    Format("geotagged photographs", is_geotagged, open_geotagged),
    Format("video or images", has_pictures, open_flight_folder),
)
"""Formats of folders, in the order of detection."""


def open_flight(
    path: Path, config: CameraConfig, telemetry: TelemetryConfig | None = None,
    mount: MountConfig | None = None,
) -> Flight:  # fmt: skip
    """Open a flight of any known format and check all of it but the telemetry.

    Of the `mount` only a gimbal counts: fixed cameras bring theirs. FlightError where the flight is
    invalid, or of no known format.
    """
    flight = format_of(path).open(path, config, telemetry or TelemetryConfig())
    flight.camera = with_readout(flight.camera, config.readout_ms)
    if mount is not None:
        flight.camera = with_mount(flight.camera, mount)
    return flight


def format_of(path: Path) -> Format:
    """Format of a file or folder; FlightError where it is none."""
    if not path.exists():
        raise FlightError(f"{path}: there is no such file or folder")
    try:
        known = next((f for f in (FOLDERS if path.is_dir() else FILES) if f.recognises(path)), None)
    except OSError as error:
        raise FlightError(f"{path}: cannot be read: {error.strerror}") from error
    if known is not None:
        return known
    if path.is_dir():
        names = ", ".join(dict.fromkeys(f.name for f in FOLDERS))
        raise FlightError(
            f"{path}: no video and no images, so not a flight; a folder can be: {names}"
        )
    if path.suffix.lower() in LOGS:
        raise FlightError(
            f"{path}: a telemetry log has no pictures; FLIGHT is the video, and this goes to --log"
        )
    names = ", ".join(f.name for f in FILES)
    raise FlightError(
        f"{path}: not a folder, and no file that holds a flight; a file can be: {names}"
    )
