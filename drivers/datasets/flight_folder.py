"""Flight folder: images, their times, a calibration and the autopilot's log."""

from __future__ import annotations

from bisect import bisect_left
from pathlib import Path

from companion.config import CameraConfig, TelemetryConfig
from companion.errors import FlightError
from companion.geometry.camera import Camera
from companion.messages import Warned
from drivers.flight import ENDS_EARLY, Flight
from drivers.images.calibration_file import assumed_camera, read_calibration, read_matrix
from drivers.images.frame_source import (
    IMAGE_SUFFIXES,
    VIDEO_SUFFIXES,
    FrameSource,
    ImageFolder,
    Video,
    find_frames,
)
from drivers.images.frame_times import read_frame_times
from drivers.telemetry.log_readers import logs_asked_for, logs_in, read_telemetry
from drivers.telemetry.telemetry_log import Pictures, TelemetryLog
from drivers.telemetry.telemetry_srt import srt_camera
from drivers.telemetry.video_alignment import read_unaligned


def is_flight_folder(path: Path) -> bool:
    """True if a folder has the frame times of a flight folder."""
    return (path / "frames.csv").is_file()


def has_pictures(path: Path) -> bool:
    """True if a folder has a video or images, the least that can be replayed."""
    wanted = VIDEO_SUFFIXES | IMAGE_SUFFIXES
    inside = [path, *(p for p in (path / "images",) if p.is_dir())]
    return any(p.suffix.lower() in wanted for folder in inside for p in folder.iterdir())


def open_flight_folder(
    path: Path, config: CameraConfig, telemetry_config: TelemetryConfig
) -> Flight:
    """Open a flight folder and check all but the telemetry; FlightError where invalid."""
    source = find_frames(path)
    numbers, times_ns, warnings = _times(path, source)
    camera, assumed = camera_of(path / "camera.json", source, config, times_ns[0])
    logs = logs_asked_for(telemetry_config, logs_in(path))

    def read_log(pictures: Pictures) -> TelemetryLog:
        if isinstance(source, Video) and not (path / "frames.csv").exists():
            return read_unaligned(logs, pictures, telemetry_config, camera, flight.frames)
        return read_telemetry(logs, pictures, telemetry_config)

    flight = Flight(path, camera, source, numbers, times_ns, [*warnings, *assumed], read_log)
    return flight


def camera_of(
    calibration: Path, source: FrameSource, config: CameraConfig, t_ns: int
) -> tuple[Camera, list[Warned]]:
    """Camera by its file or `K.txt` beside it, else an assumed one, with a warning."""
    if calibration.exists():
        camera = read_calibration(calibration, source.width, source.height)
        detail = f"{calibration.name} says so itself"
        return camera, [Warned(t_ns, "the camera is assumed", detail)] if camera.assumed else []
    matrix = calibration.with_name("K.txt")
    if matrix.exists():
        return read_matrix(matrix, source.width, source.height), []
    by_srt = (
        srt_camera(source.path, source.width, source.height) if isinstance(source, Video) else None
    )
    if by_srt is not None:
        camera, detail = by_srt
        return camera, [Warned(t_ns, "no camera.json: the lens is that of the subtitles", detail)]
    if config.assumed_hfov_deg <= 0:
        raise FlightError(
            f"{calibration.parent}: no camera.json; give one, or a field of view by "
            "camera.assumed_hfov_deg"
        )
    detail = f"{config.assumed_hfov_deg:g} degrees wide, no distortion, place on body unknown"
    warned = Warned(t_ns, "no camera.json: the camera is assumed", detail)
    return assumed_camera(source.width, source.height, config.assumed_hfov_deg), [warned]


def own_times(source: Video | ImageFolder) -> tuple[list[int], list[int], list[Warned]]:
    """Numbers and times of all frames by the file itself, with a warning."""
    epoch_ns, epoch = source.epoch()
    times_ns = [epoch_ns + t_ns for t_ns in source.own_times_ns()]
    what = "no frames.csv: times are the file's own"
    warned = Warned(times_ns[0], what, f"counted from {epoch}")
    return list(range(len(times_ns))), times_ns, [warned]


def _times(path: Path, source: Video | ImageFolder) -> tuple[list[int], list[int], list[Warned]]:
    listed = path / "frames.csv"
    if not listed.exists():
        return own_times(source)
    numbers, times_ns, warnings = read_frame_times(listed)
    n_there = bisect_left(numbers, source.n_frames)
    if n_there == 0:
        raise FlightError(
            f"{listed}: its first index is {numbers[0]}, and {source.path.name} has only "
            f"{source.n_frames} frames"
        )
    if n_there < len(numbers):
        detail = f"{source.n_frames} frames, frames.csv goes on to {numbers[-1]}"
        warnings.append(Warned(times_ns[n_there - 1], ENDS_EARLY, detail))
    elif numbers[-1] + 1 < source.n_frames:
        detail = f"{source.n_frames - numbers[-1] - 1} frames at the end have no time"
        warnings.append(Warned(times_ns[-1], "frames.csv ends early", detail))
    return numbers[:n_there], times_ns[:n_there], warnings
