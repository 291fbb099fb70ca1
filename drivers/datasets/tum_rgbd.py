"""TUM RGB-D sequences and others of that layout: images in `rgb.txt`.

Depth images (`depth.txt`) are registered to them, 5000 units a metre.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from companion.config import CameraConfig, TelemetryConfig
from companion.geometry.camera import Camera, Distortion
from companion.messages import Bytes, Floats, Warned
from drivers.flight import Flight, TruePose
from drivers.images.calibration_file import read_calibration
from drivers.images.listed_images import listed_images
from drivers.images.picture_file import read_grey, read_picture
from drivers.images.stereo_pair import Depths, corners_of
from drivers.images.text_table import ns_of_seconds, numbers_of, pose_of, read_rows
from drivers.telemetry.measured_depths import with_depths
from drivers.telemetry.telemetry_log import Pictures, TelemetryLog, no_telemetry

TUM_CAMERAS = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "freiburg2": (520.9, 521.0, 325.1, 249.7, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "freiburg3": (535.4, 539.2, 320.1, 247.6, (0.0, 0.0, 0.0, 0.0, 0.0)),
}
TUM_CAMERA = (525.0, 525.0, 319.5, 239.5, (0.0, 0.0, 0.0, 0.0, 0.0))
SIGMA_AT_1_M = 1.425e-3
"""Grows with the square of the depth (Khoshelham and Elberink 2012, of the first Kinect)."""
MAX_SPREAD_RATIO = 0.05
"""Of the 3 x 3 depths about a corner: beyond it lies on an edge, and could be either side's."""
UNITS_PER_M = np.float32(5000.0)
SAME_PICTURE_NS = 20_000_000
"""Between stamps of colour and depth, as in the benchmark's own tools."""


def is_tum_rgbd(path: Path) -> bool:
    """True if a folder is a TUM RGB-D sequence."""
    return (path / "rgb.txt").is_file()


def open_tum_rgbd(path: Path, config: CameraConfig, telemetry: TelemetryConfig) -> Flight:
    """Colour images of a sequence, and depths where it has depth images.

    FlightError where it is incomplete.
    """
    listing = path / "rgb.txt"
    stamped = [(ns_of_seconds(listing, t), path / name) for t, name, *_ in read_rows(listing, 2)]
    source, numbers, times_ns, warnings = listed_images(listing, stamped)
    stated = path / "camera.json"
    if stated.is_file():
        camera = read_calibration(stated, source.width, source.height)
    else:
        camera, of = _usual_camera(path, source.width, source.height)
        warnings.append(Warned(times_ns[0], "no camera.json: the benchmark's camera is taken", of))

    def read_log(pictures: Pictures) -> TelemetryLog:
        if not (path / "depth.txt").is_file() or "depth" not in telemetry.use:
            return no_telemetry(pictures)
        return _depths(path, stamped, camera)

    return Flight(path, camera, source, numbers, times_ns, warnings, read_log, lambda: _truth(path))


def _depths(path: Path, stamped: Sequence[tuple[int, Path]], camera: Camera) -> TelemetryLog:
    """Depths by the depth camera: all the telemetry that there is."""
    listing = path / "depth.txt"
    depth = [(ns_of_seconds(listing, t), path / name) for t, name, *_ in read_rows(listing, 2)]

    def measure(here: Path, there: Path) -> Depths | None:
        grey = read_grey(here, camera.width, camera.height)
        units = read_picture(there, cv2.IMREAD_UNCHANGED)
        if grey is None or units is None or units.shape != grey.shape:
            return None
        return depths_at_corners(grey, units.astype(np.float32) / UNITS_PER_M)

    level = Warned(stamped[0][0], "no attitude", "the world is level as the first picture is")
    log = TelemetryLog(listing.name, (), warnings=(level,))
    return with_depths(log, stamped, depth, SAME_PICTURE_NS, "the depth camera", measure)


def _usual_camera(path: Path, width: int, height: int) -> tuple[Camera, str]:
    name = next((name for name in TUM_CAMERAS if name in path.resolve().name), None)
    fx, fy, cx, cy, distortion = TUM_CAMERAS[name] if name else TUM_CAMERA
    scale = width / 640
    model = Distortion.RADTAN if any(distortion) else Distortion.NONE
    camera = Camera(
        width, height, fx * scale, fy * scale, (cx + 0.5) * scale - 0.5, (cy + 0.5) * scale - 0.5,
        model, distortion if any(distortion) else (), assumed=name is None,
    )  # fmt: skip
    return camera, name or "of no known one, so that of ROS's driver"


def _truth(path: Path) -> list[TruePose]:
    listing = path / "groundtruth.txt"
    return tum_poses(listing) if listing.is_file() else []


def tum_poses(listing: Path) -> list[TruePose]:
    """Poses of a file in the benchmark's format; FlightError if invalid."""
    out = []
    for t, *words in read_rows(listing, 8):
        x, y, z, qx, qy, qz, qw = numbers_of(listing, words[:7])
        pose = pose_of(listing, (x, y, z), (qw, qx, qy, qz))
        out.append(TruePose(ns_of_seconds(listing, t), pose))
    return out


def depths_at_corners(grey: Bytes, depth_m: Floats) -> Depths:
    """Depths at corners of a picture (H, W) by a depth image (H, W) in metres, 0 where unknown."""
    height, width = depth_m.shape
    at = corners_of(grey)
    column, row = np.rint(at).astype(int).T
    inside = (column > 0) & (row > 0) & (column < width - 1) & (row < height - 1)
    at, column, row = at[inside], column[inside], row[inside]
    step = np.arange(-1, 2)
    about = depth_m[row[:, None, None] + step[:, None], column[:, None, None] + step]
    about = about.reshape(-1, 9).astype(np.float64)
    ok = (about.min(1) > 0) & (np.ptp(about, axis=1) < MAX_SPREAD_RATIO * about.min(1))
    found = np.median(about[ok], axis=1)
    return Depths(at[ok].astype(np.float64), found, SIGMA_AT_1_M * found**2, float("nan"))
