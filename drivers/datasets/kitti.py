"""KITTI odometry sequences: `calib.txt`, `times.txt`, `image_2/` or `image_0/`.

The true poses lie beside the sequences, `poses/NN.txt`, and are those of the left grey camera.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from companion.config import CameraConfig, TelemetryConfig
from companion.errors import FlightError
from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose
from companion.messages import Warned
from drivers.flight import Flight, TruePose
from drivers.images.frame_source import IMAGE_SUFFIXES
from drivers.images.listed_images import listed_images
from drivers.images.text_table import ns_of_seconds, numbers_of, read_rows
from drivers.telemetry.telemetry_log import no_telemetry

CAMERAS = ("image_2", "image_0", "image_3", "image_1")
"""Folders of images, in order of preference: colour, then left."""


def is_kitti(path: Path) -> bool:
    """True if a folder is a sequence of KITTI odometry."""
    return (path / "times.txt").is_file() and (path / "calib.txt").is_file()


def open_kitti(path: Path, config: CameraConfig, telemetry: TelemetryConfig) -> Flight:
    """One camera of a sequence; FlightError where it is incomplete."""
    folder = next((path / name for name in CAMERAS if (path / name).is_dir()), None)
    if folder is None:
        raise FlightError(f"{path}: no images; wanted is one of {', '.join(CAMERAS)}")
    listing = path / "times.txt"
    times = [ns_of_seconds(listing, words[0]) for words in read_rows(listing, 1)]
    files = sorted(p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES)
    if not files:
        raise FlightError(f"{folder}: there are no images in it")
    n = min(len(times), len(files))
    source, numbers, times_ns, warnings = listed_images(
        folder / files[0].name, list(zip(times[:n], files[:n], strict=True))
    )
    if len(times) != len(files):
        detail = f"{len(times)} times, {len(files)} images in {folder.name}"
        warnings.append(Warned(times_ns[0], "times.txt and the images differ in number", detail))
    matrix = _projection(path / "calib.txt", f"P{folder.name[-1]}")
    fx, fy, cx, cy = (float(matrix[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    camera = Camera(source.width, source.height, fx, fy, cx, cy)
    # P = K [1 | t]: the pictures are rectified, so that t only shifts
    shift_m = np.asarray(np.linalg.solve(matrix[:, :3], matrix[:, 3]), np.float64)
    shift = Pose(np.eye(3), shift_m)
    return Flight(
        path, camera, source, numbers, times_ns, warnings, no_telemetry,
        lambda: _truth(path, times, shift.inverse()),
    )  # fmt: skip


def _projection(calibration: Path, name: str) -> Array:
    for key, *words in read_rows(calibration, 2):
        if key.rstrip(":") == name and len(words) == 12:
            matrix = np.array(numbers_of(calibration, words)).reshape(3, 4)
            if min(matrix[0, 0], matrix[1, 1], matrix[2, 2]) <= 0:
                break
            return matrix
    raise FlightError(f"{calibration}: wanted a line {name}: with the twelve numbers of a camera")


def _truth(path: Path, times: list[int], first_from_this: Pose) -> list[TruePose]:
    listing = path.parent.parent / "poses" / f"{path.resolve().name}.txt"
    if not listing.is_file():
        return []
    rows = read_rows(listing, 12)
    out = []
    for t_ns, words in zip(times, rows, strict=False):
        world_from_first = Pose.from_matrix(np.reshape(numbers_of(listing, words[:12]), (3, 4)))
        out.append(TruePose(t_ns, world_from_first @ first_from_this))
    return out
