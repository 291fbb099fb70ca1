"""Single video, with files of the same name beside it, as a flight."""

from __future__ import annotations

from pathlib import Path

from companion.config import CameraConfig, TelemetryConfig
from drivers.datasets.flight_folder import camera_of, own_times
from drivers.flight import Flight
from drivers.images.frame_source import VIDEO_SUFFIXES, Video
from drivers.telemetry.log_readers import logs_asked_for, logs_beside
from drivers.telemetry.video_alignment import read_unaligned


def is_video(path: Path) -> bool:
    """True if a file is a video by its name."""
    return path.suffix.lower() in VIDEO_SUFFIXES


def open_video(path: Path, config: CameraConfig, telemetry: TelemetryConfig) -> Flight:
    """Open a video; its log is the one of the same name, its calibration NAME.json."""
    source = Video(path)
    numbers, times_ns, own = own_times(source)
    camera, warnings = camera_of(path.with_suffix(".json"), source, config, times_ns[0])
    logs = logs_asked_for(telemetry, logs_beside(path))
    flight = Flight(
        path, camera, source, numbers, times_ns, [*own, *warnings],
        lambda pictures: read_unaligned(logs, pictures, telemetry, camera, flight.frames),
    )  # fmt: skip
    return flight
