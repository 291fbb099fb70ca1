"""Single video, with files of the same name beside it, as a flight."""

from __future__ import annotations

from pathlib import Path

from companion.config import CameraConfig, TelemetryConfig
from companion.messages import Warned
from drivers.datasets.flight_folder import camera_of
from drivers.flight import Flight
from drivers.images.frame_source import VIDEO_SUFFIXES, Video
from drivers.telemetry.telemetry_folder import logs_asked_for, logs_beside
from drivers.telemetry.video_alignment import read_unaligned


def is_video(path: Path) -> bool:
    """True if a file is a video by its name."""
    return path.suffix.lower() in VIDEO_SUFFIXES


def open_video(path: Path, config: CameraConfig, telemetry: TelemetryConfig) -> Flight:
    """Open a video; its log is the one of the same name, its calibration NAME.json."""
    source = Video(path)
    epoch_ns, epoch = source.epoch()
    times_ns = [epoch_ns + t_ns for t_ns in source.own_times_ns()]
    camera, warnings = camera_of(path.with_suffix(".json"), source, config, times_ns[0])
    own = Warned(times_ns[0], "no frames.csv: times are the file's own", f"counted from {epoch}")
    logs = logs_asked_for(telemetry, logs_beside(path))
    flight = Flight(
        path, camera, source, list(range(source.n_frames)), times_ns, [own, *warnings],
        lambda pictures: read_unaligned(logs, pictures, telemetry, camera, flight.frames),
    )  # fmt: skip
    return flight
